/* A Modbus TCP server of libmodbus for many connections: modbus_server ADDRESS:PORT. */
#include <arpa/inet.h>
#include <errno.h>
#include <modbus/modbus.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

enum { MOST = 128 };

static void fail(const char *what)
{
    fprintf(stderr, "%s: %s\n", what, modbus_strerror(errno));
    exit(1);
}

int main(int argc, char **argv)
{
    char *port = argc == 2 ? strchr(argv[1], ':') : NULL;
    if (!port) {
        fprintf(stderr, "modbus_server ADDRESS:PORT\n");
        return 2;
    }
    *port++ = 0;
    modbus_t *context = modbus_new_tcp(argv[1], atoi(port));
    modbus_mapping_t *registers = modbus_mapping_new(512, 512, 512, 512);
    if (!context || !registers)
        fail("start");
    int listener = modbus_tcp_listen(context, MOST);
    if (listener < 0)
        fail("listen");
    /* As the controller does; a system that refuses refuses it there too. */
    struct sched_param priority = {.sched_priority = 1};
    sched_setscheduler(0, SCHED_FIFO, &priority);
    puts("ready");
    fflush(stdout);
    struct pollfd sockets[MOST] = {{listener, POLLIN, 0}};
    nfds_t count = 1;
    for (;;) {
        if (poll(sockets, count, -1) < 0)
            fail("poll");
        for (nfds_t at = count; at-- > 1;) {
            uint8_t request[MODBUS_TCP_MAX_ADU_LENGTH];
            if (!sockets[at].revents)
                continue;
            modbus_set_socket(context, sockets[at].fd);
            int length = modbus_receive(context, request);
            if (length > 0)
                length = modbus_reply(context, request, length, registers);
            if (length < 0) {
                close(sockets[at].fd);
                sockets[at] = sockets[--count];
            }
        }
        if (sockets[0].revents && count < MOST) {
            int yes = 1, client = accept(listener, NULL, NULL);
            if (client < 0)
                fail("accept");
            setsockopt(client, IPPROTO_TCP, TCP_NODELAY, &yes, sizeof yes);
            sockets[count++] = (struct pollfd){client, POLLIN, 0};
        }
    }
}
