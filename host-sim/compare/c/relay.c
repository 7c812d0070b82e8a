/* What somebody would write for one frame: relay LINK ADDRESS:PORT makes a pseudoterminal, and a link to it at LINK. Each
 * frame 255 255 a b c 238 238 on it becomes a Modbus request that writes a, b and c to the registers from 0 on. Nothing is
 * known of age, of what the controller says, or of a lost connection. */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <fcntl.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <unistd.h>

enum { FRAME = 7 };

static void check(int result, const char *what)
{
    if (result < 0) {
        perror(what);
        exit(1);
    }
}

int main(int argc, char **argv)
{
    char *port = argc == 3 ? strchr(argv[2], ':') : NULL;
    if (!port) {
        fprintf(stderr, "relay LINK ADDRESS:PORT\n");
        return 2;
    }
    *port++ = 0;
    int line = posix_openpt(O_RDWR | O_NOCTTY);
    check(line, "posix_openpt");
    check(grantpt(line), "grantpt");
    check(unlockpt(line), "unlockpt");
    /* Held open, or the line hangs up with each device that leaves. */
    int device = open(ptsname(line), O_RDWR | O_NOCTTY);
    check(device, "open");
    struct termios raw;
    check(tcgetattr(device, &raw), "tcgetattr");
    cfmakeraw(&raw);
    check(tcsetattr(device, TCSANOW, &raw), "tcsetattr");
    check(symlink(ptsname(line), argv[1]), "symlink");

    int yes = 1, robot = socket(AF_INET, SOCK_STREAM, 0);
    struct sockaddr_in to = {.sin_family = AF_INET, .sin_port = htons(atoi(port))};
    check(robot, "socket");
    check(inet_pton(AF_INET, argv[2], &to.sin_addr) == 1 ? 0 : -1, "inet_pton");
    check(connect(robot, (struct sockaddr *)&to, sizeof to), "connect");
    check(setsockopt(robot, IPPROTO_TCP, TCP_NODELAY, &yes, sizeof yes), "TCP_NODELAY");
    struct sched_param priority = {.sched_priority = 1};
    puts(sched_setscheduler(0, SCHED_FIFO, &priority) == 0 ? "ready fifo" : "ready ordinary");
    fflush(stdout);

    unsigned char waiting[4096], answers[4096];
    unsigned char request[] = {0, 0, 0, 0, 0, 13, 1, 16, 0, 0, 0, 3, 6, 0, 0, 0, 0, 0, 0};
    size_t count = 0;
    struct pollfd both[] = {{line, POLLIN, 0}, {robot, POLLIN, 0}};
    for (;;) {
        check(poll(both, 2, -1), "poll");
        if (both[1].revents && read(robot, answers, sizeof answers) <= 0)
            return 0;
        if (!both[0].revents)
            continue;
        ssize_t length = read(line, waiting + count, sizeof waiting - count);
        check(length, "read");
        count += length;
        size_t at = 0;
        while (count - at >= FRAME) {
            const unsigned char *frame = waiting + at;
            if (frame[0] != 255 || frame[1] != 255 || frame[5] != 238 || frame[6] != 238) {
                at++;
                continue;
            }
            request[1]++;
            request[14] = frame[2];
            request[16] = frame[3];
            request[18] = frame[4];
            check(write(robot, request, sizeof request), "write");
            at += FRAME;
        }
        memmove(waiting, waiting + at, count - at);
        count -= at;
    }
}
