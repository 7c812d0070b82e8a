/* What gateway.c needs from a board; board_m7.c and board_host.c are two boards. */
#ifndef BOARD_H
#define BOARD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "rgw.h"

enum { LINKS = 5 }; /* command, state, Modbus, recipes by UDP, and one more */

/* What happened; BOARD_NOTHING when `until_us` has come and everything that arrived was reported. */
enum board_event_kind { BOARD_NOTHING, BOARD_PORT_BYTES, BOARD_PORT_SENT, BOARD_LINK_UP, BOARD_LINK_DOWN,
                        BOARD_LINK_BYTES, BOARD_LINK_SENT, BOARD_LINK_ACKED, BOARD_STOP };
struct board_event {
    enum board_event_kind kind;
    uint8_t id;         /* port or link */
    uint32_t left;      /* bytes not acknowledged yet */
    const uint8_t *bytes;
    size_t len;
};

/* The configuration image. */
extern const uint8_t *board_image(size_t *len);
/* Microseconds since the start. */
extern uint64_t board_now_us(void);
/* Sets up a serial line as configured. */
extern bool board_port_open(uint8_t port, const rgw_port_settings *settings);
/* None of these waits: */
extern void board_port_send(uint8_t port, const uint8_t *bytes, size_t len);
extern void board_link_open(uint8_t link, rgw_transport transport, const uint8_t *host, size_t len, uint16_t port);
extern void board_link_close(uint8_t link);
extern void board_link_send(uint8_t link, const uint8_t *bytes, size_t len);
/* Waits until something happens or that instant has come. */
extern struct board_event board_wait(uint64_t until_us);
/* Prints a line. */
extern void board_say(const char *what, uint32_t number);

#endif
