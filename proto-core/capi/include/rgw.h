/* The gateway engine for programs in C; README.md of proto-core/capi says how. Made by cbindgen. */

#ifndef RGW_H
#define RGW_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

// Newest version of the configuration images that this library reads. Older versions are read too.
#define RGW_IMAGE_VERSION 4

// Memory for a configuration, in bytes: enough on every machine. It is needed until
// `rgw_gateway_configure` has returned.
#define RGW_CONFIG_SIZE 22528

// Maximum number of exchanges with devices of all ports together.
#define RGW_MAX_EXCHANGES 16

// Field ports that a gateway has room for.
#define RGW_MAX_PORTS 4

// Recipe links that a gateway has room for.
#define RGW_MAX_RECIPE_LINKS 2

// User-defined fields on all ports together that a gateway has room for, in each direction.
#define RGW_MAX_FIELDS 128

// Memory for a gateway, in bytes: enough on every machine.
#define RGW_GATEWAY_SIZE 61440

// Number of the link to port 2000.
#define RGW_LINK_COMMAND 0

// Number of the link to port 2001.
#define RGW_LINK_STATE 1

// Number of the Modbus link.
#define RGW_LINK_MODBUS 2

// Number of the link to the UDP recipe server of the controller.
#define RGW_LINK_RECIPE_UDP 3

// Number of the link of port 0, if that is a listening port; the numbers of other ports follow.
#define RGW_LINK_FIRST_PORT 4

// Number of the second link to port 2000, for commands that stop the robot. It is the highest number.
#define RGW_LINK_URGENT 12

// Alignment of all memory that a program gives to this library, in bytes.
#define RGW_ALIGN 16

// Bytes of the buffer for `rgw_poll_output`.
#define RGW_OUTPUT_BUFFER 512

// `until_us` of a gateway without a configuration: it never has a task.
#define RGW_NEVER UINT64_MAX

// Version of this interface: one more for every change of a function, a type or a number in it.
// `rgw_gateway_init` refuses a program that was compiled with another version of the header.
#define RGW_ABI_VERSION 2

// Status of a call. Zero is success. After any other status nothing has changed, unless the function says
// otherwise.
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
  // The program was compiled with another version of the header.
  RGW_STATUS_ABI_VERSION = 4,
  // There is no such port, link or index.
  RGW_STATUS_NOT_THERE = 5,
  // Not a valid code or CAN frame.
  RGW_STATUS_INVALID = 6,
  // The image is cut short.
  RGW_STATUS_IMAGE_CUT = 16,
  // It is not a configuration image.
  RGW_STATUS_IMAGE_NONE = 17,
  // The image has a version that this library does not read; `rgw_image_version` says which.
  RGW_STATUS_IMAGE_VERSION = 18,
  // The image announces more bytes than an image can have.
  RGW_STATUS_IMAGE_TOO_LONG = 19,
  // The image is damaged.
  RGW_STATUS_IMAGE_DAMAGED = 20,
  // The image does not contain a configuration.
  RGW_STATUS_IMAGE_CONTENTS = 21,
  // The configuration in the image is invalid; `host-sim check` says why.
  RGW_STATUS_CONFIG_WRONG = 22,
  // A variable of the configuration has no way to or from the controller.
  RGW_STATUS_CONFIG_PLAN = 23,
  // The configuration is larger than this library was built for.
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

// The bus of a port.
enum rgw_port_kind
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint8_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  // A half-duplex serial line.
  RGW_PORT_KIND_RS485 = 0,
  // A CAN bus.
  RGW_PORT_KIND_CAN = 1,
  // A TCP port that the controller connects to: a link, not a field port.
  RGW_PORT_KIND_TCP_LISTEN = 2,
  // A UDP port that the controller sends to: a link, not a field port.
  RGW_PORT_KIND_UDP_LISTEN = 3,
  // Devices of Modbus TCP: a field port that has a link and no device of its own.
  RGW_PORT_KIND_MODBUS_TCP = 4,
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
  // Its input frames come in time; a port without an input part only has to be there.
  RGW_PORT_HEALTH_WORKING = 0,
  // An input frame is overdue, or none has come yet.
  RGW_PORT_HEALTH_SILENT = 1,
  // Its CAN controller is bus-off.
  RGW_PORT_HEALTH_BUS_OFF = 2,
  // Its device is gone.
  RGW_PORT_HEALTH_GONE = 3,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum rgw_port_health rgw_port_health;
#else
typedef uint8_t rgw_port_health;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// State of a link.
enum rgw_link_health
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint8_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  // Closed; it is opened again later.
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

// The kinds of tasks of a driver.
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
  // the buffer are the controller's address or name as configured, without a terminating zero.
  RGW_TASK_KIND_LINK_OPEN = 3,
  // Close the link `id` at once, TCP with a reset, and report nothing more of it.
  RGW_TASK_KIND_LINK_CLOSE = 4,
  // Send `len` bytes of the buffer on the link `id` (UDP: one datagram), then `rgw_link_sent`.
  RGW_TASK_KIND_LINK_SEND = 5,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum rgw_task_kind rgw_task_kind;
#else
typedef uint8_t rgw_task_kind;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// The transport of a link, and the side that opens it.
enum rgw_transport
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint8_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  // Connect by TCP.
  RGW_TRANSPORT_TCP = 0,
  // Send UDP datagrams and receive the answers.
  RGW_TRANSPORT_UDP = 1,
  // Listen, and accept one TCP connection.
  RGW_TRANSPORT_TCP_LISTEN = 2,
  // Receive UDP datagrams, and answer the newest sender.
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
  // Error-active, with low error counters.
  RGW_CAN_STATE_ACTIVE = 0,
  // An error counter has reached 96.
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

// The result of the newest command that a port's values picked.
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
  // The controller sent another reply.
  RGW_REPLY_CODE_OTHER = 4,
  // No reply came in time, or the link was lost before it came.
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

// A configuration in the caller's memory: at most 6 ports, 6 recipes with 256 fields together, 32
// commands, 32 safe values and 16 exchanges.
typedef struct rgw_config rgw_config;

// A gateway in the caller's memory; it must not be moved.
typedef struct rgw_gateway rgw_gateway;

// What a driver sets up for a port.
typedef struct rgw_port_settings {
  // Its bus.
  rgw_port_kind kind;
  // Parity of a serial line.
  rgw_parity parity;
  // Stop bits of a serial line, 1 or 2; 0 on other buses.
  uint8_t stop_bits;
  // Bit/s of a serial line or a CAN bus; 0 on other buses.
  uint32_t bit_rate;
} rgw_port_settings;

// The board's own address, and its network.
typedef struct rgw_network_settings {
  // The address.
  uint8_t address[4];
  // The router; 0.0.0.0 if there is none.
  uint8_t router[4];
  // The name server; 0.0.0.0 if there is none.
  uint8_t dns[4];
  // Prefix length of the network in bits, 1 to 30.
  uint8_t prefix;
} rgw_network_settings;

// Counters of a field port. They wrap after 2^32.
typedef struct rgw_port_counters {
  // Frames accepted.
  uint32_t frames_in;
  // Bytes received (CAN: data bytes).
  uint32_t bytes_in;
  // Frames handed over to the driver.
  uint32_t frames_out;
  // Bytes handed over to the driver (CAN: data bytes).
  uint32_t bytes_out;
  // Frames rejected for a value that is not finite (D22).
  uint32_t rejected_not_finite;
  // Frames rejected because a bound value did not fit its variable (D22).
  uint32_t rejected_out_of_range;
  // CAN frames ignored because the recipe does not have their id (D17).
  uint32_t rejected_id;
  // CAN frames rejected because their length is not the declared one (D17).
  uint32_t rejected_length;
  // Remote frames ignored (D17).
  uint32_t rejected_remote;
  // Frames rejected because their checksum is wrong.
  uint32_t rejected_checksum;
  // Frames rejected because a field is not a number, such as a letter among digits.
  uint32_t rejected_unreadable;
  // Frames that are right and of another device: a constant is not ours.
  uint32_t rejected_other_device;
  // Frames rejected because their alive counter is that of the frame before: the device may be
  // frozen.
  uint32_t rejected_counter;
  // Fields of accepted frames of devices that were rejected.
  uint32_t rejected_fields;
  // Fields of accepted frames that have no value now, as the device says.
  uint32_t fields_without_value;
  // Frames received on a port whose recipe has no input part.
  uint32_t rejected_no_input;
  // Frames that began with the head but did not end with the tail (D19).
  uint32_t tail_mismatches;
  // Bytes dropped while looking for a frame (D19).
  uint32_t resync_bytes;
  // Bytes of partial frames discarded after silence (D19), and bytes discarded because they waited
  // while the gateway itself slept.
  uint32_t discarded_bytes;
  // Chunks of bytes, or CAN frames, discarded because they waited while the gateway itself slept.
  uint32_t asleep;
  // Accepted frames in which reserved bits were masked (D22).
  uint32_t masked;
  // Accepted frames whose alive counter is not the next one: frames between are missing.
  uint32_t counter_jumps;
  // Frames with a text that is ignored, such as that of a scanner that read nothing.
  uint32_t ignored;
  // Bit values replaced by newer ones because the queue of edges was full.
  uint32_t edges_lost;
  // Values dropped before they were written: older than the port's timeout, or waiting for a link
  // that was lost.
  uint32_t values_expired;
  // Accepted frames with a value that was dropped because its link was down.
  uint32_t undelivered;
  // Accepted frames with a value that was withheld until its neighbours were read back.
  uint32_t withheld;
  // Cycles in which no output frame could be sent in time (D20).
  uint32_t skipped_cycles;
  // Cycles in which no output frame was sent because its sources were stale or unknown.
  uint32_t stale_cycles;
  // Requests without a good reply, after all repetitions.
  uint32_t unanswered;
  // Requests that the device refused.
  uint32_t refused;
  // Times an input frame became overdue.
  uint32_t timeouts;
  // Times the device was reported gone.
  uint32_t downs;
  // Times the CAN controller was reported bus-off.
  uint32_t bus_offs;
  // Commands picked by a value.
  uint32_t commands;
  // Commands that could not be sent.
  uint32_t commands_dropped;
  // Values in no entry of their command table.
  uint32_t commands_unknown;
  // Values in a command table that only set the base.
  uint32_t commands_based;
} rgw_port_counters;

// A field port.
typedef struct rgw_port_info_t {
  // Its counters.
  struct rgw_port_counters counters;
  // Its health.
  rgw_port_health health;
  // The result of the newest command that its values picked: one of `rgw_reply_code`.
  uint8_t reply_code;
} rgw_port_info_t;

// Counters of a link. They wrap after 2^32.
typedef struct rgw_link_counters {
  // Times the link came up.
  uint32_t connects;
  // Times it was lost after it had been up, whichever side closed it.
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
  // Requests without an answer within the timeout.
  uint32_t timeouts;
  // Exceptions and failure replies.
  uint32_t refused;
  // Malformed answers, frames and packets.
  uint32_t malformed;
  // Received values that were not finite; the variables are unknown until a readable value comes.
  uint32_t unreadable;
  // Connections reset because the peer's transport had not acknowledged data before its deadline.
  uint32_t unacknowledged;
  // Bytes dropped while looking for a frame.
  uint32_t resync_bytes;
  // Time from the newest request to its answer, in microseconds.
  uint32_t round_trip_us;
  // The longest such time, in microseconds.
  uint32_t round_trip_max_us;
} rgw_link_counters;

// A link to the controller.
typedef struct rgw_link_info_t {
  // Its counters.
  struct rgw_link_counters counters;
  // The link's number, such as `RGW_LINK_MODBUS`.
  uint8_t id;
  // Its state.
  rgw_link_health health;
} rgw_link_info_t;

// A classic CAN frame.
typedef struct rgw_can_frame {
  // Its id of 11 or 29 bits.
  uint32_t id;
  // Whether the id has 29 bits.
  uint8_t extended;
  // Whether it is a remote frame, which has no data.
  uint8_t remote;
  // Data bytes, 0 to 8.
  uint8_t len;
  // The data; zero after `len`.
  uint8_t data[8];
} rgw_can_frame;

// A task of a driver; fields that its kind does not name are zero.
typedef struct rgw_task {
  // When to call `rgw_tick` at the latest, in microseconds of the driver's clock.
  uint64_t until_us;
  // Number of bytes, from the beginning of the buffer.
  size_t len;
  // A CAN frame.
  struct rgw_can_frame frame;
  // TCP or UDP port.
  uint16_t port;
  // Its kind.
  rgw_task_kind kind;
  // The port or the link.
  uint8_t id;
  // How the link is opened.
  rgw_transport transport;
} rgw_task;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

// Size of a configuration on this machine, in bytes; at most `RGW_CONFIG_SIZE`.
size_t rgw_config_size(void);

// The version of an image, whether this library can read it or not.
//
// # Safety
// `image` points to `len` bytes, and `version` to room for a number.
rgw_status rgw_image_version(const uint8_t *image, size_t len, uint32_t *version);

// Reads an image into `memory`, checks the configuration in it, and sets `*config` to it. If it is
// refused, `*config` is not set and the memory is free again.
//
// # Safety
// `memory` points to `len` bytes that nothing else uses as long as the configuration is in use; `image`
// points to `image_len` bytes elsewhere, and `config` to room for a pointer.
rgw_status rgw_config_read(void *memory,
                           size_t len,
                           const uint8_t *image,
                           size_t image_len,
                           struct rgw_config **config);

// Number of ports of a configuration, field ports and others; 0 for a null pointer.
//
// # Safety
// `config` is from `rgw_config_read`, and its memory has not been used for anything else.
size_t rgw_config_ports(const struct rgw_config *config);

// What a driver sets up for the port with this number, counted from 0.
//
// # Safety
// `config` is from `rgw_config_read`, and its memory has not been used for anything else; `settings`
// points to room for the result.
rgw_status rgw_config_port(const struct rgw_config *config, uint8_t port, struct rgw_port_settings *settings);

// The board's own address; `RGW_STATUS_NOT_THERE` if it comes from DHCP.
//
// # Safety
// `config` is from `rgw_config_read`, and its memory has not been used for anything else; `settings`
// points to room for the result.
rgw_status rgw_config_network(const struct rgw_config *config, struct rgw_network_settings *settings);

// Size of a gateway on this machine, in bytes; at most `RGW_GATEWAY_SIZE`.
size_t rgw_gateway_size(void);

// Makes a gateway without a configuration in `memory`, and sets `*gateway` to it. `abi_version` is
// `RGW_ABI_VERSION` of the header that the program was compiled with. Nothing has to be freed: the
// gateway ends when its memory is used for something else.
//
// # Safety
// `memory` points to `len` bytes that nothing else uses as long as the gateway is in use; `gateway`
// points to room for a pointer.
rgw_status rgw_gateway_init(uint32_t abi_version, void *memory, size_t len, struct rgw_gateway **gateway);

// Gives a gateway its configuration, and drops the previous one: all ports and links are down then. If
// the configuration is refused, the gateway has none and does nothing.
//
// # Safety
// `gateway` is from `rgw_gateway_init` and `config` from `rgw_config_read`; their memory has not been
// used for anything else.
rgw_status rgw_gateway_configure(struct rgw_gateway *gateway, const struct rgw_config *config);

// State and counters of a field port, by its number; `RGW_STATUS_NOT_THERE` if there is no such field port.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else; `info`
// points to room for the result.
rgw_status rgw_port_info(const struct rgw_gateway *gateway, uint8_t port, struct rgw_port_info_t *info);

// State and counters of the `nth` link, counted from 0; `RGW_STATUS_NOT_THERE` after the last.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else; `info`
// points to room for the result.
rgw_status rgw_link_info(const struct rgw_gateway *gateway, size_t nth, struct rgw_link_info_t *info);

// Times the gateway slept: it was not called for more than half a second, and what waited for it was
// discarded. The number wraps; 0 for a null pointer.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
uint32_t rgw_sleeps(const struct rgw_gateway *gateway);

// Whether a datagram is a frame of the link's output part. The driver of a listening UDP link asks this
// before it answers another sender than before. False for null pointers.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else; `datagram`
// points to `len` bytes.
bool rgw_is_frame(const struct rgw_gateway *gateway, uint8_t link, const uint8_t *datagram, size_t len);

// Time has passed, and everything that arrived before has been reported: the only input that lets
// deadlines pass.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
rgw_status rgw_tick(struct rgw_gateway *gateway, uint64_t now_us);

// A port's device is there.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
rgw_status rgw_port_up(struct rgw_gateway *gateway, uint64_t now_us, uint8_t port);

// A port's device is gone; what was handed over is lost, and no `rgw_port_sent` follows for it.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
rgw_status rgw_port_down(struct rgw_gateway *gateway, uint64_t now_us, uint8_t port);

// Everything that was handed over has left the port.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
rgw_status rgw_port_sent(struct rgw_gateway *gateway, uint64_t now_us, uint8_t port);

// Bytes from a serial line, in chunks of any size.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else; `data`
// points to `len` bytes.
rgw_status rgw_port_bytes(struct rgw_gateway *gateway,
                          uint64_t now_us,
                          uint8_t port,
                          const uint8_t *data,
                          size_t len);

// A frame from a CAN bus.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else; `frame`
// points to a frame.
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

// The transport has taken everything that was handed over, and has room for more.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else.
rgw_status rgw_link_sent(struct rgw_gateway *gateway, uint64_t now_us, uint8_t link);

// Bytes from a link; of a datagram link one whole datagram a call.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else; `data`
// points to `len` bytes.
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

// The driver's next task. Call it again until the kind is `RGW_TASK_KIND_SLEEP`. The bytes of a task are
// in `buffer` and stay there until the next call.
//
// # Safety
// `gateway` is from `rgw_gateway_init`, and its memory has not been used for anything else; `buffer`
// points to `len` bytes and `task` to room for a task, both elsewhere.
rgw_status rgw_poll_output(struct rgw_gateway *gateway,
                           uint64_t now_us,
                           uint8_t *buffer,
                           size_t len,
                           struct rgw_task *task);

// The library's version of this interface; a program compares it with `RGW_ABI_VERSION`.
uint32_t rgw_abi_version(void);

// A status in English words: a static text that ends with a zero byte. Takes any number.
const char *rgw_status_text(uint32_t status);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* RGW_H */
