/* A whole gateway in one loop, on a board as in board.h: one RS-485 port, and links to the controller.
 * All memory is static; nothing is allocated, nothing is called back. */
#include "board.h"

static _Alignas(RGW_ALIGN) uint8_t gateway_memory[RGW_GATEWAY_SIZE];
static _Alignas(RGW_ALIGN) uint8_t config_memory[RGW_CONFIG_SIZE];
static uint8_t buffer[RGW_OUTPUT_BUFFER];

static rgw_gateway *start(void)
{
    rgw_gateway *gateway = NULL;
    rgw_config *config = NULL;
    rgw_port_settings settings;
    size_t len;
    const uint8_t *image = board_image(&len);
    rgw_status status = rgw_gateway_init(RGW_ABI_VERSION, gateway_memory, sizeof gateway_memory, &gateway);
    if (status == RGW_STATUS_OK)
        status = rgw_config_read(config_memory, sizeof config_memory, image, len, &config);
    if (status == RGW_STATUS_OK)
        status = rgw_gateway_configure(gateway, config);
    if (status != RGW_STATUS_OK) {
        board_say(rgw_status_text(status), status);
        return NULL;
    }
    for (uint8_t port = 0; rgw_config_port(config, port, &settings) == RGW_STATUS_OK; port++)
        if (settings.kind == RGW_PORT_KIND_RS485 && board_port_open(port, &settings))
            rgw_port_up(gateway, board_now_us(), port);
    return gateway; /* the configuration's memory is free now */
}

/* Carries out all tasks, and returns when to call the gateway again at the latest. */
static uint64_t carry_out(rgw_gateway *gateway)
{
    rgw_task task;
    while (rgw_poll_output(gateway, board_now_us(), buffer, sizeof buffer, &task) == RGW_STATUS_OK) {
        switch (task.kind) {
        case RGW_TASK_KIND_PORT_SEND: board_port_send(task.id, buffer, task.len); break;
        case RGW_TASK_KIND_LINK_OPEN: board_link_open(task.id, task.transport, buffer, task.len, task.port); break;
        case RGW_TASK_KIND_LINK_CLOSE: board_link_close(task.id); break;
        case RGW_TASK_KIND_LINK_SEND: board_link_send(task.id, buffer, task.len); break;
        case RGW_TASK_KIND_PORT_SEND_CAN: break; /* no CAN bus here */
        case RGW_TASK_KIND_SLEEP: return task.until_us;
        }
    }
    return 0;
}

static void report(const rgw_gateway *gateway)
{
    rgw_port_info_t port;
    rgw_link_info_t link;
    if (rgw_port_info(gateway, 0, &port) == RGW_STATUS_OK) {
        board_say("frames in", port.counters.frames_in);
        board_say("frames out", port.counters.frames_out);
    }
    for (size_t nth = 0; rgw_link_info(gateway, nth, &link) == RGW_STATUS_OK; nth++) {
        board_say("link", link.id);
        board_say("connects", link.counters.connects);
        board_say("answers", link.counters.received);
    }
    board_say("sleeps", rgw_sleeps(gateway));
}

int main(void)
{
    rgw_gateway *gateway = start();
    if (gateway == NULL)
        return 1;
    for (;;) {
        struct board_event event = board_wait(carry_out(gateway));
        uint64_t now = board_now_us();
        switch (event.kind) {
        case BOARD_NOTHING: rgw_tick(gateway, now); break;
        case BOARD_PORT_BYTES: rgw_port_bytes(gateway, now, event.id, event.bytes, event.len); break;
        case BOARD_PORT_SENT: rgw_port_sent(gateway, now, event.id); break;
        case BOARD_LINK_UP: rgw_link_up(gateway, now, event.id); break;
        case BOARD_LINK_DOWN: rgw_link_down(gateway, now, event.id); break;
        case BOARD_LINK_BYTES: rgw_link_bytes(gateway, now, event.id, event.bytes, event.len); break;
        case BOARD_LINK_SENT: rgw_link_sent(gateway, now, event.id); break;
        case BOARD_LINK_ACKED: rgw_link_acked(gateway, now, event.id, event.left); break;
        case BOARD_STOP: report(gateway); return 0;
        }
    }
}
