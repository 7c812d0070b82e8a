/* The gateway engine for programs in C; README.md of proto-core/capi says how. Made by cbindgen. */

#ifndef RGW_H
#define RGW_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

// Version of the configuration images that this library reads; those of older versions are read too
// where they can be.
#define RGW_IMAGE_VERSION 2

// Memory that a configuration takes, in bytes: as much as on any machine. It is needed until
// `rgw_gateway_configure` has returned.
#define RGW_CONFIG_SIZE 16640

// Field ports that a gateway has room for.
#define RGW_MAX_PORTS 4

// Recipe links that a gateway has room for.
#define RGW_MAX_RECIPE_LINKS 2

// User-defined fields over all ports that a gateway has room for, in each direction.
#define RGW_MAX_FIELDS 128

// Memory that a gateway takes, in bytes: as much as on any machine.
#define RGW_GATEWAY_SIZE 37888

// Number of the link to port 2000.
#define RGW_LINK_COMMAND 0

// Number of the link to port 2001.
#define RGW_LINK_STATE 1

// Number of the Modbus link.
#define RGW_LINK_MODBUS 2

// Number of the link to the UDP recipe server of the controller.
#define RGW_LINK_RECIPE_UDP 3

// Number of the link of the first port, if it is one that listens; those of other ports follow.
#define RGW_LINK_FIRST_PORT 4

// Number of the second link to port 2000, for commands that stop the robot. No link has a higher one.
#define RGW_LINK_URGENT 12

// Alignment of all memory that is given to this library, in bytes.
#define RGW_ALIGN 16

// Bytes of the buffer for `rgw_poll_output`.
#define RGW_OUTPUT_BUFFER 512

// `until_us` of a gateway without a configuration: nothing will ever have to be done.
#define RGW_NEVER UINT64_MAX

// Version of this interface: one more for every change of a function, a type or a number in it.
// `rgw_gateway_init` refuses a program that was compiled with the header of another one.
#define RGW_ABI_VERSION 1

// What became of a call. Zero is success, and nothing was changed where it is not, unless the function
// says otherwise.
enum rgw_status
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  // Done.
  RGW_STATUS_OK = 0,
  // A pointer is null.
  RGW_STATUS_NULL = 1,
  // Memory or a buffer is too small.
  RGW_STATUS_TOO_SMALL = 2,
  // Memory is not aligned to `RGW_ALIGN`.
  RGW_STATUS_MISALIGNED = 3,
  // The program was compiled with the header of another version.
  RGW_STATUS_ABI_VERSION = 4,
  // A port, a link or an index that is not there.
  RGW_STATUS_NOT_THERE = 5,
  // A code or a CAN frame that cannot be.
  RGW_STATUS_INVALID = 6,
  // The image is cut short.
  RGW_STATUS_IMAGE_CUT = 16,
  // It is not a configuration image.
  RGW_STATUS_IMAGE_NONE = 17,
  // The image has a version that this library does not read; `rgw_image_version` says which.
  RGW_STATUS_IMAGE_VERSION = 18,
  // The image says that it is longer than any.
  RGW_STATUS_IMAGE_TOO_LONG = 19,
  // The image is damaged.
  RGW_STATUS_IMAGE_DAMAGED = 20,
  // The image holds no configuration.
  RGW_STATUS_IMAGE_CONTENTS = 21,
  // The configuration in the image is wrong; `host-sim check` says how.
  RGW_STATUS_CONFIG_WRONG = 22,
  // A variable of the configuration has no way to or from the controller.
  RGW_STATUS_CONFIG_PLAN = 23,
  // The configuration has more of something than this library was built for.
  RGW_STATUS_CONFIG_TOO_LARGE = 24,
  // The configuration names a dialect that this library does not know.
  RGW_STATUS_CONFIG_DIALECT = 25,
  // The image or the configuration is refused for another reason.
  RGW_STATUS_OTHER = 31,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum rgw_status rgw_status;
#else
typedef uint32_t rgw_status;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// What a port is.
enum rgw_port_kind
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint8_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  // A half-duplex serial line.
  RGW_PORT_KIND_RS485 = 0,
  // A CAN bus.
  RGW_PORT_KIND_CAN = 1,
  // Where the controller connects to by TCP. A link, not a field port.
  RGW_PORT_KIND_TCP_LISTEN = 2,
  // Where the controller sends datagrams to. A link, not a field port.
  RGW_PORT_KIND_UDP_LISTEN = 3,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum rgw_port_kind rgw_port_kind;
#else
typedef uint8_t rgw_port_kind;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// A serial line's parity.
enum rgw_parity
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint8_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  // No parity bit.
  RGW_PARITY_NONE = 0,
  // Even.
  RGW_PARITY_EVEN = 1,
  // Odd.
  RGW_PARITY_ODD = 2,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum rgw_parity rgw_parity;
#else
typedef uint8_t rgw_parity;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// Health of a field port.
enum rgw_port_health
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint8_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  // What it receives comes in time; a port without an input part only has to be there.
  RGW_PORT_HEALTH_WORKING = 0,
  // A frame of its input part is overdue or has never come.
  RGW_PORT_HEALTH_SILENT = 1,
  // The CAN controller has left the bus.
  RGW_PORT_HEALTH_BUS_OFF = 2,
  // Its device is not there.
  RGW_PORT_HEALTH_GONE = 3,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum rgw_port_health rgw_port_health;
#else
typedef uint8_t rgw_port_health;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// Where a link stands.
enum rgw_link_health
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint8_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  // Closed, and opened again later.
  RGW_LINK_HEALTH_DOWN = 0,
  // Opened, not yet up.
  RGW_LINK_HEALTH_OPENING = 1,
  // Usable.
  RGW_LINK_HEALTH_UP = 2,
  // Not opened: the controller takes only one connection; another link carries its traffic.
  RGW_LINK_HEALTH_SHARED = 3,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum rgw_link_health rgw_link_health;
#else
typedef uint8_t rgw_link_health;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// What a driver has to do.
enum rgw_task_kind
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint8_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  // Nothing before `until_us`; then `rgw_tick` at the latest.
  RGW_TASK_KIND_SLEEP = 0,
  // Send `len` bytes of the buffer on the serial line `id`, then `rgw_port_sent`.
  RGW_TASK_KIND_PORT_SEND = 1,
  // Queue `frame` on the CAN bus `id`; `rgw_port_sent` when the queue has become empty.
  RGW_TASK_KIND_PORT_SEND_CAN = 2,
  // Open the link `id` by `transport` at `port`, then `rgw_link_up` or `rgw_link_down`. `len` bytes of
  // the buffer are the controller's address or name as configured, without a zero behind.
  RGW_TASK_KIND_LINK_OPEN = 3,
  // Close the link `id` at once and report nothing more of it; of TCP, with a reset.
  RGW_TASK_KIND_LINK_CLOSE = 4,
  // Send `len` bytes of the buffer on the link `id` (by UDP: one datagram), then `rgw_link_sent`.
  RGW_TASK_KIND_LINK_SEND = 5,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum rgw_task_kind rgw_task_kind;
#else
typedef uint8_t rgw_task_kind;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// How a link is opened.
enum rgw_transport
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint8_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  // Connect by TCP.
  RGW_TRANSPORT_TCP = 0,
  // Send UDP datagrams, and receive the answers.
  RGW_TRANSPORT_UDP = 1,
  // Listen, and take one TCP connection.
  RGW_TRANSPORT_TCP_LISTEN = 2,
  // Receive UDP datagrams, and answer whoever sent last.
  RGW_TRANSPORT_UDP_LISTEN = 3,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum rgw_transport rgw_transport;
#else
typedef uint8_t rgw_transport;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// A CAN controller's error state; `rgw_port_bus` takes its number.
enum rgw_can_state
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint8_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  // Error-active: all is well.
  RGW_CAN_STATE_ACTIVE = 0,
  // An error counter passed 96.
  RGW_CAN_STATE_WARNING = 1,
  // Error-passive.
  RGW_CAN_STATE_PASSIVE = 2,
  // Bus-off: nothing can be sent until the driver recovers it and reports another state.
  RGW_CAN_STATE_BUS_OFF = 3,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum rgw_can_state rgw_can_state;
#else
typedef uint8_t rgw_can_state;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// How the newest command went that a port's values picked.
enum rgw_reply_code
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint8_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  // No value has picked a command yet.
  RGW_REPLY_CODE_NONE = 0,
  // Waiting to be sent, or for the reply.
  RGW_REPLY_CODE_PENDING = 1,
  // The controller replied that it succeeded.
  RGW_REPLY_CODE_SUCCESS = 2,
  // The controller replied that it failed.
  RGW_REPLY_CODE_FAIL = 3,
  // The controller replied something else.
  RGW_REPLY_CODE_OTHER = 4,
  // No reply came in time, or the link was lost meanwhile.
  RGW_REPLY_CODE_NO_REPLY = 5,
  // It was not sent: the link was down, or too many were waiting.
  RGW_REPLY_CODE_NOT_SENT = 6,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum rgw_reply_code rgw_reply_code;
#else
typedef uint8_t rgw_reply_code;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// A configuration in the caller's memory: 6 ports, 6 recipes with 256 fields, 32 commands and 32 safe
// values at most.
typedef struct rgw_config rgw_config;

// A gateway in the caller's memory; it has to stay where it is.
typedef struct rgw_gateway rgw_gateway;

// What a driver sets up for a port.
typedef struct rgw_port_settings {
  // What it is.
  rgw_port_kind kind;
  // Of a serial line.
  rgw_parity parity;
  // Of a serial line: 1 or 2.
  uint8_t stop_bits;
  // Bit/s of a serial line or a CAN bus; 0 of others.
  uint32_t bit_rate;
} rgw_port_settings;

// The board's own address and what belongs to it.
typedef struct rgw_network_settings {
  // The address.
  uint8_t address[4];
  // The way to other networks; 0.0.0.0 for none.
  uint8_t router[4];
  // The server that knows the controller's name; 0.0.0.0 for none.
  uint8_t dns[4];
  // Bits of the network, 1 to 30.
  uint8_t prefix;
} rgw_network_settings;

// What happened on a field port. Counters wrap after 2^32.
typedef struct rgw_port_counters {
  // Frames accepted.
  uint32_t frames_in;
  // Bytes received (CAN: data bytes).
  uint32_t bytes_in;
  // Frames handed over for sending.
  uint32_t frames_out;
  // Bytes handed over for sending (CAN: data bytes).
  uint32_t bytes_out;
  // Frames rejected for a value that is not finite (D22).
  uint32_t rejected_not_finite;
  // Frames rejected because a bound value did not fit its variable (D22).
  uint32_t rejected_out_of_range;
  // CAN frames ignored for an id that the recipe does not have (D17).
  uint32_t rejected_id;
  // CAN frames rejected for another length than declared (D17).
  uint32_t rejected_length;
  // Remote frames ignored (D17).
  uint32_t rejected_remote;
  // Frames on a port whose recipe has no input part.
  uint32_t rejected_no_input;
  // Heads whose frame did not end in the tail (D19).
  uint32_t tail_mismatches;
  // Bytes dropped while looking for a frame (D19).
  uint32_t resync_bytes;
  // Bytes of partial frames discarded after silence (D19), and bytes that waited while the gateway
  // itself slept.
  uint32_t discarded_bytes;
  // Chunks of bytes, or CAN frames, discarded because they waited while the gateway itself slept.
  uint32_t asleep;
  // Accepted frames in which reserved bits were masked (D22).
  uint32_t masked;
  // Bit values that were replaced by newer ones because the queue of edges was full.
  uint32_t edges_lost;
  // Values dropped before they could be written: older than the port's timeout, or waiting for a
  // link that was lost.
  uint32_t values_expired;
  // Accepted frames with a value that could not be passed on: its link was down.
  uint32_t undelivered;
  // Accepted frames with a value that had to wait for its neighbours to be read back.
  uint32_t withheld;
  // Cycles in which no output frame could be sent in time (D20).
  uint32_t skipped_cycles;
  // Cycles in which no output frame was sent because its sources were stale or unknown.
  uint32_t stale_cycles;
  // Times the field frame was overdue.
  uint32_t timeouts;
  // Times the device was reported gone.
  uint32_t downs;
  // Times the CAN controller was reported bus-off.
  uint32_t bus_offs;
  // Commands picked by a value.
  uint32_t commands;
  // Commands that could not be sent.
  uint32_t commands_dropped;
} rgw_port_counters;

// A field port.
typedef struct rgw_port_info_t {
  // What happened.
  struct rgw_port_counters counters;
  // Its health.
  rgw_port_health health;
  // How the newest command went that its values picked: one of `rgw_reply_code`.
  uint8_t reply_code;
} rgw_port_info_t;

// What happened on a link. Counters wrap after 2^32.
typedef struct rgw_link_counters {
  // Times the link came up.
  uint32_t connects;
  // Times it was lost after it had been up, whoever closed it.
  uint32_t losses;
  // Times it could not be opened.
  uint32_t failed_opens;
  // Times it was closed because nothing arrived.
  uint32_t silences;
  // Requests, frames or commands sent.
  uint32_t sent;
  // Answers, frames or packets accepted.
  uint32_t received;
  // Bytes received.
  uint32_t bytes_in;
  // Requests without an answer in time.
  uint32_t timeouts;
  // Exceptions and failure replies.
  uint32_t refused;
  // Answers, frames and packets that made no sense.
  uint32_t malformed;
  // Values received that were not finite: they are unknown until a readable one comes.
  uint32_t unreadable;
  // Connections reset because the peer's transport had not acknowledged what was handed over by
  // the time after which it must not be delivered.
  uint32_t unacknowledged;
  // Bytes dropped while looking for a frame.
  uint32_t resync_bytes;
  // Microseconds from the newest request to its answer.
  uint32_t round_trip_us;
  // The longest of these.
  uint32_t round_trip_max_us;
} rgw_link_counters;

// A link to the controller.
typedef struct rgw_link_info_t {
  // What happened.
  struct rgw_link_counters counters;
  // The link's number, such as `RGW_LINK_MODBUS`.
  uint8_t id;
  // Where it stands.
  rgw_link_health health;
} rgw_link_info_t;

// A classic CAN frame.
typedef struct rgw_can_frame {
  // 11 or 29 bits.
  uint32_t id;
  // Whether the id has 29 bits.
  uint8_t extended;
  // Whether it is a remote frame; its data does not count then.
  uint8_t remote;
  // Data bytes, 0 to 8.
  uint8_t len;
  // The data; zero behind `len`.
  uint8_t data[8];
} rgw_can_frame;

// What a driver has to do; what its kind does not name is zero.
typedef struct rgw_task {
  // When to call `rgw_tick` at the latest, in microseconds of the driver's clock.
  uint64_t until_us;
  // Bytes of the buffer, from its beginning.
  size_t len;
  // A CAN frame.
  struct rgw_can_frame frame;
  // TCP or UDP port.
  uint16_t port;
  // What to do.
  rgw_task_kind kind;
  // The port or the link.
  uint8_t id;
  // How a link is opened.
  rgw_transport transport;
} rgw_task;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

// Size of a configuration here, in bytes; at most `RGW_CONFIG_SIZE`.
size_t rgw_config_size(void);

// The version of an image, whether it can be read here or not.
//
// # Safety
// There are `len` bytes at `image`, and room for a number at `version`.
rgw_status rgw_image_version(const uint8_t *image, size_t len, uint32_t *version);

// Reads an image and checks the configuration in it. `*config` is in `memory` then; when it is refused,
// the memory holds nothing and is free again.
//
// # Safety
// There are `len` bytes at `memory`, which nobody else uses as long as the configuration is used; there
// are `image_len` bytes at `image`, elsewhere; there is room for a pointer at `config`.
rgw_status rgw_config_read(void *memory,
                           size_t len,
                           const uint8_t *image,
                           size_t image_len,
                           struct rgw_config **config);

// How many ports a configuration has, field ports and others; 0 for a null pointer.
//
// # Safety
// `config` is from `rgw_config_read`, and its memory has not been used for anything else.
size_t rgw_config_ports(const struct rgw_config *config);

// What a driver sets up for a port, the `port`th of the configuration, counted from 0.
//
// # Safety
// `config` is from `rgw_config_read`, and its memory has not been used for anything else; there is room
// at `settings`.
rgw_status rgw_config_port(const struct rgw_config *config, uint8_t port, struct rgw_port_settings *settings);

// The board's own address; `RGW_STATUS_NOT_THERE` when DHCP is to be asked.
//
// # Safety
// `config` is from `rgw_config_read`, and its memory has not been used for anything else; there is room
// at `settings`.
rgw_status rgw_config_network(const struct rgw_config *config, struct rgw_network_settings *settings);

// Size of a gateway here, in bytes; at most `RGW_GATEWAY_SIZE`.
size_t rgw_gateway_size(void);

// Makes a gateway without a configuration in the caller's memory. `*gateway` is in `memory` then.
// `abi_version` is `RGW_ABI_VERSION`, as the program's header has it. There is nothing to be freed:
// memory that is used for something else ends the gateway.
//
// # Safety
// There are `len` bytes at `memory`, which nobody else uses as long as the gateway is used; there is room
// for a pointer at `gateway`.
rgw_status rgw_gateway_init(uint32_t abi_version, void *memory, size_t len, struct rgw_gateway **gateway);

// Gives a gateway its configuration, instead of one that it may have had: all ports and links are down
// then. When it is refused, the gateway has none and does nothing.
//
// # Safety
// `gateway` is from `rgw_gateway_init` and `config` from `rgw_config_read`; their memory has not been
// used for anything else.
rgw_status rgw_gateway_configure(struct rgw_gateway *gateway, const struct rgw_config *config);

// A field port, by its number; `RGW_STATUS_NOT_THERE` if it is none.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else; there is room
// at `info`.
rgw_status rgw_port_info(const struct rgw_gateway *gateway, uint8_t port, struct rgw_port_info_t *info);

// The links one after the other: the `nth`, counted from 0; `RGW_STATUS_NOT_THERE` behind the last.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else; there is room
// at `info`.
rgw_status rgw_link_info(const struct rgw_gateway *gateway, size_t nth, struct rgw_link_info_t *info);

// How often the gateway slept: it was not called for more than half a second, and what waited for it was
// discarded. Wraps; 0 for a null pointer.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
uint32_t rgw_sleeps(const struct rgw_gateway *gateway);

// Whether a datagram is a frame of the link's output part: what the driver of a listening UDP link asks
// before it answers another sender than so far. No for null pointers.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else; there are
// `len` bytes at `datagram`.
bool rgw_is_frame(const struct rgw_gateway *gateway, uint8_t link, const uint8_t *datagram, size_t len);

// Time has passed, and everything that arrived before has been told: the only input that lets deadlines
// pass.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
rgw_status rgw_tick(struct rgw_gateway *gateway, uint64_t now_us);

// A port's device is there.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
rgw_status rgw_port_up(struct rgw_gateway *gateway, uint64_t now_us, uint8_t port);

// A port's device is gone; what was handed over for sending is lost, and no `rgw_port_sent` follows for it.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
rgw_status rgw_port_down(struct rgw_gateway *gateway, uint64_t now_us, uint8_t port);

// Everything that was handed over for sending has left the port.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
rgw_status rgw_port_sent(struct rgw_gateway *gateway, uint64_t now_us, uint8_t port);

// Bytes from a serial line, in chunks of any size.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else; there are
// `len` bytes at `data`.
rgw_status rgw_port_bytes(struct rgw_gateway *gateway,
                          uint64_t now_us,
                          uint8_t port,
                          const uint8_t *data,
                          size_t len);

// A frame from a CAN bus.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else; there is a
// frame at `frame`.
rgw_status rgw_port_can(struct rgw_gateway *gateway,
                        uint64_t now_us,
                        uint8_t port,
                        const struct rgw_can_frame *frame);

// A CAN controller's error state changed; `state` is one of `rgw_can_state`.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
rgw_status rgw_port_bus(struct rgw_gateway *gateway, uint64_t now_us, uint8_t port, uint8_t state);

// A link that was to be opened is usable.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
rgw_status rgw_link_up(struct rgw_gateway *gateway, uint64_t now_us, uint8_t link);

// A link could not be opened, or was lost; no `rgw_link_sent` follows for what was handed over to it.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
rgw_status rgw_link_down(struct rgw_gateway *gateway, uint64_t now_us, uint8_t link);

// Everything that was handed over for sending was taken by the transport, which has room for more.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
rgw_status rgw_link_sent(struct rgw_gateway *gateway, uint64_t now_us, uint8_t link);

// Bytes from a link; of a datagram link one whole datagram a call.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else; there are
// `len` bytes at `data`.
rgw_status rgw_link_bytes(struct rgw_gateway *gateway,
                          uint64_t now_us,
                          uint8_t link,
                          const uint8_t *data,
                          size_t len);

// How much of what was handed over to a TCP link, since it came up, the peer's transport has not
// acknowledged, in bytes. Reported before bytes that arrived, and at least every 20 ms while it changes.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
rgw_status rgw_link_acked(struct rgw_gateway *gateway, uint64_t now_us, uint8_t link, uint32_t left);

// What the driver has to do next; called again until it is `RGW_TASK_KIND_SLEEP`. The bytes are in
// `buffer` and stay there until the next call.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else; there are
// `len` bytes at `buffer` and room at `task`, elsewhere.
rgw_status rgw_poll_output(struct rgw_gateway *gateway,
                           uint64_t now_us,
                           uint8_t *buffer,
                           size_t len,
                           struct rgw_task *task);

// The version of this interface that the library has; a program compares it with `RGW_ABI_VERSION`.
uint32_t rgw_abi_version(void);

// A status in words: English, for ever, ends with a zero byte. Any number is taken.
const char *rgw_status_text(uint32_t status);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* RGW_H */
