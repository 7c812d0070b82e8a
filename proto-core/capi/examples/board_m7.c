/* A Cortex-M7: QEMU's mps2-an500, with memcpy and the like as its only library. UART 0 is the serial line
 * of the device. UARTs 1, 2 and 3 are the links 0, 1 and 2 (commands, state, Modbus); QEMU connects them
 * to TCP connections. Such a line is up when it is opened, cannot be closed, and has no acknowledgements
 * of its own. UART 4 is the console; a byte received there ends the program. */
#include "board.h"

#define REGISTER(address) (*(volatile uint32_t *)(address))

enum { DATA = 0x0, STATE = 0x4, CTRL = 0x8, BAUDDIV = 0x10, TX_FULL = 1, RX_FULL = 2, LINES = 3 };
static const uint32_t uarts[5] = { 0x40004000, 0x40005000, 0x40006000, 0x40007000, 0x40009000 };
enum { CONSOLE = 4 };

extern uint32_t stack_top, data_start, data_end, data_load, bss_start, bss_end;
extern const uint8_t image_start[], image_end[];
extern int main(void);

static uint8_t received[64];
static bool port_sent, is_open[LINES], was_open[LINES], link_up[LINES], link_sent[LINES], link_acked[LINES], link_absent[LINKS];

const uint8_t *board_image(size_t *len)
{
    *len = (size_t)(image_end - image_start);
    return image_start;
}

uint64_t board_now_us(void)
{
    /* A counter of 32 bits that counts microseconds. */
    static uint32_t low, high;
    uint32_t now = REGISTER(0x40028018);
    if (now < low)
        high++;
    low = now;
    return (uint64_t)high << 32 | low;
}

static void put(unsigned uart, const uint8_t *bytes, size_t len)
{
    for (; len > 0; len--) {
        while (REGISTER(uarts[uart] + STATE) & TX_FULL) { }
        REGISTER(uarts[uart] + DATA) = *bytes++;
    }
}

static size_t take(unsigned uart)
{
    size_t len = 0;
    while (len < sizeof received && (REGISTER(uarts[uart] + STATE) & RX_FULL))
        received[len++] = (uint8_t)REGISTER(uarts[uart] + DATA);
    return len;
}

bool board_port_open(uint8_t port, const rgw_port_settings *settings)
{
    return port == 0 && settings->bit_rate > 0; /* the emulated line has no speed */
}

void board_port_send(uint8_t port, const uint8_t *bytes, size_t len)
{
    (void)port;
    put(0, bytes, len);
    port_sent = true;
}

void board_link_open(uint8_t link, rgw_transport transport, const uint8_t *host, size_t len, uint16_t port)
{
    (void)transport, (void)host, (void)len, (void)port; /* QEMU has connected it */
    if (link < LINES)
        is_open[link] = was_open[link] = link_up[link] = true;
    else if (link < LINKS)
        link_absent[link] = true;
}

void board_link_close(uint8_t link)
{
    if (link < LINES)
        is_open[link] = link_up[link] = link_sent[link] = link_acked[link] = false;
}

void board_link_send(uint8_t link, const uint8_t *bytes, size_t len)
{
    if (link < LINES && is_open[link]) {
        put(1 + link, bytes, len);
        link_sent[link] = link_acked[link] = true;
    }
}

static bool told(bool *flag)
{
    bool was = *flag;
    *flag = false;
    return was;
}

struct board_event board_wait(uint64_t until_us)
{
    for (;;) {
        bool is_late = board_now_us() >= until_us;
        if (told(&port_sent))
            return (struct board_event){ .kind = BOARD_PORT_SENT };
        for (uint8_t id = 0; id < LINKS; id++)
            if (told(&link_absent[id]))
                return (struct board_event){ .kind = BOARD_LINK_DOWN, .id = id };
        size_t len = take(0);
        if (len > 0)
            return (struct board_event){ .kind = BOARD_PORT_BYTES, .bytes = received, .len = len };
        for (uint8_t id = 0; id < LINES; id++) {
            if (told(&link_up[id]))
                return (struct board_event){ .kind = BOARD_LINK_UP, .id = id };
            if (told(&link_sent[id]))
                return (struct board_event){ .kind = BOARD_LINK_SENT, .id = id };
            if (told(&link_acked[id]))
                return (struct board_event){ .kind = BOARD_LINK_ACKED, .id = id };
            /* Bytes before the first opening are the beginning of the stream; bytes after a closing
             * belong to a connection that is gone. */
            len = was_open[id] ? take(1u + id) : 0;
            if (len > 0 && is_open[id])
                return (struct board_event){ .kind = BOARD_LINK_BYTES, .id = id, .bytes = received, .len = len };
        }
        if (take(CONSOLE) > 0)
            return (struct board_event){ .kind = BOARD_STOP };
        if (is_late)
            return (struct board_event){ .kind = BOARD_NOTHING };
    }
}

void board_say(const char *what, uint32_t number)
{
    uint8_t digits[12];
    size_t at = sizeof digits;
    digits[--at] = '\n';
    do
        digits[--at] = (uint8_t)('0' + number % 10);
    while ((number /= 10) > 0);
    digits[--at] = ' ';
    while (*what != '\0')
        put(CONSOLE, (const uint8_t *)what++, 1);
    put(CONSOLE, digits + at, sizeof digits - at);
}

/* Ends QEMU. */
static _Noreturn void ends(int code)
{
    const uint32_t block[2] = { 0x20026, (uint32_t)code };
    register uint32_t operation __asm__("r0") = 0x20;
    register const uint32_t *argument __asm__("r1") = block;
    __asm__ volatile("bkpt 0xAB" : : "r"(operation), "r"(argument) : "memory");
    for (;;) { }
}

_Noreturn void reset(void)
{
    REGISTER(0xE000ED88) |= 0xF << 20; /* the floating-point unit */
    __asm__ volatile("dsb\n isb");
    for (uint32_t *to = &data_start, *from = &data_load; to < &data_end;)
        *to++ = *from++;
    for (uint32_t *to = &bss_start; to < &bss_end;)
        *to++ = 0;
    for (unsigned uart = 0; uart < 5; uart++) {
        REGISTER(uarts[uart] + BAUDDIV) = 217;
        REGISTER(uarts[uart] + CTRL) = 3;
    }
    REGISTER(0x4002801C) = 24; /* 25 MHz by 25 */
    ends(main());
}

static void fault(void) { ends(101); }

__attribute__((section(".vectors"), used)) static void *const vectors[16] = {
    &stack_top, (void *)reset, (void *)fault, (void *)fault, (void *)fault, (void *)fault, (void *)fault,
};

__asm__(".section .rodata.image, \"a\"\n .global image_start, image_end\n"
        "image_start: .incbin \"" IMAGE "\"\nimage_end:\n .text\n");
