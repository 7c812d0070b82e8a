/* A Linux process as a board: the device on the serial line is a TCP server, links are sockets.
 *
 *     gateway IMAGE PORT        PORT: TCP port of the device at 127.0.0.1
 *
 * It ends when its standard input has something to read, or ends. */
#include <arpa/inet.h>
#include <errno.h>
#include <linux/sockios.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "board.h"

struct link {
    int fd;
    bool opening, failed, sent;
    int left; /* as reported last */
};
static struct link links[LINKS] = { [0 ... LINKS - 1] = { .fd = -1 } };
static int field = -1;
static bool port_sent;
static uint8_t image[16 * 1024], received[1536];
static size_t image_len;

const uint8_t *board_image(size_t *len) { *len = image_len; return image; }

uint64_t board_now_us(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000 + (uint64_t)now.tv_nsec / 1000;
}

static int connected(const char *host, uint16_t port, bool wait)
{
    struct sockaddr_in to = { .sin_family = AF_INET, .sin_port = htons(port) };
    int one = 1, fd = socket(AF_INET, SOCK_STREAM | (wait ? 0 : SOCK_NONBLOCK), 0);
    setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &one, sizeof one);
    if (inet_pton(AF_INET, host, &to.sin_addr) == 1
        && (connect(fd, (struct sockaddr *)&to, sizeof to) == 0 || errno == EINPROGRESS))
        return fd;
    close(fd);
    return -1;
}

bool board_port_open(uint8_t port, const rgw_port_settings *settings)
{
    fprintf(stderr, "port %u: %u bit/s\n", port, settings->bit_rate);
    return field >= 0;
}

void board_port_send(uint8_t port, const uint8_t *bytes, size_t len)
{
    (void)port;
    if (write(field, bytes, len) != (ssize_t)len)
        fprintf(stderr, "the device takes nothing\n");
    port_sent = true;
}

void board_link_open(uint8_t link, rgw_transport transport, const uint8_t *host, size_t len, uint16_t port)
{
    char name[65] = "";
    if (link >= LINKS)
        return;
    memcpy(name, host, len < 64 ? len : 64);
    links[link] = (struct link){ .fd = transport == RGW_TRANSPORT_TCP ? connected(name, port, false) : -1 };
    links[link].opening = links[link].fd >= 0;
    links[link].failed = links[link].fd < 0;
}

void board_link_close(uint8_t link)
{
    /* With a reset, nothing unacknowledged is delivered later. */
    struct linger reset = { .l_onoff = 1, .l_linger = 0 };
    if (link >= LINKS || links[link].fd < 0)
        return;
    setsockopt(links[link].fd, SOL_SOCKET, SO_LINGER, &reset, sizeof reset);
    close(links[link].fd);
    links[link] = (struct link){ .fd = -1 };
}

void board_link_send(uint8_t link, const uint8_t *bytes, size_t len)
{
    /* Only one request is in flight at a time; a socket has room for it. */
    if (link < LINKS && links[link].fd >= 0 && send(links[link].fd, bytes, len, MSG_NOSIGNAL) == (ssize_t)len)
        links[link].sent = true;
    else if (link < LINKS)
        links[link].failed = true;
}

static struct board_event down(uint8_t id)
{
    if (links[id].fd >= 0)
        close(links[id].fd);
    links[id] = (struct link){ .fd = -1 };
    return (struct board_event){ .kind = BOARD_LINK_DOWN, .id = id };
}

static struct board_event readable(uint8_t id)
{
    struct link *link = &links[id];
    if (link->opening) {
        int error = 0;
        socklen_t size = sizeof error;
        getsockopt(link->fd, SOL_SOCKET, SO_ERROR, &error, &size);
        link->opening = false;
        return error ? down(id) : (struct board_event){ .kind = BOARD_LINK_UP, .id = id };
    }
    ssize_t len = read(link->fd, received, sizeof received);
    if (len <= 0)
        return down(id);
    return (struct board_event){ .kind = BOARD_LINK_BYTES, .id = id, .bytes = received, .len = (size_t)len };
}

struct board_event board_wait(uint64_t until_us)
{
    for (;;) {
        struct pollfd all[LINKS + 2] = { { .fd = 0, .events = POLLIN }, { .fd = field, .events = POLLIN } };
        if (port_sent) {
            port_sent = false;
            return (struct board_event){ .kind = BOARD_PORT_SENT };
        }
        bool is_watched = false;
        for (uint8_t id = 0; id < LINKS; id++) {
            struct link *link = &links[id];
            int left = 0;
            if (link->failed)
                return down(id);
            if (link->sent) {
                link->sent = false;
                return (struct board_event){ .kind = BOARD_LINK_SENT, .id = id };
            }
            if (link->fd >= 0 && !link->opening && ioctl(link->fd, SIOCOUTQ, &left) == 0 && left != link->left) {
                link->left = left;
                return (struct board_event){ .kind = BOARD_LINK_ACKED, .id = id, .left = (uint32_t)left };
            }
            is_watched |= link->left > 0;
            all[id + 2] = (struct pollfd){ .fd = link->fd, .events = link->opening ? POLLOUT : POLLIN };
        }
        uint64_t now = board_now_us();
        uint64_t wait_us = until_us > now ? until_us - now : 0;
        if (is_watched && wait_us > 10000)
            wait_us = 10000;
        int count = poll(all, LINKS + 2, (int)((wait_us + 999) / 1000));
        if (count > 0 && all[0].revents)
            return (struct board_event){ .kind = BOARD_STOP };
        if (count > 0 && all[1].revents) {
            ssize_t len = read(field, received, sizeof received);
            if (len <= 0)
                return (struct board_event){ .kind = BOARD_STOP };
            return (struct board_event){ .kind = BOARD_PORT_BYTES, .bytes = received, .len = (size_t)len };
        }
        for (uint8_t id = 0; count > 0 && id < LINKS; id++)
            if (all[id + 2].revents)
                return readable(id);
        if (count == 0 && board_now_us() >= until_us)
            return (struct board_event){ .kind = BOARD_NOTHING };
    }
}

void board_say(const char *what, uint32_t number) { printf("%s %u\n", what, number); }

/* Runs before main of gateway.c. */
__attribute__((constructor)) static void board_start(int argc, char **argv)
{
    FILE *file = argc == 3 ? fopen(argv[1], "rb") : NULL;
    if (file == NULL) {
        fprintf(stderr, "usage: gateway IMAGE FIELD-PORT\n");
        exit(2);
    }
    image_len = fread(image, 1, sizeof image, file);
    fclose(file);
    field = connected("127.0.0.1", (uint16_t)atoi(argv[2]), true);
}
