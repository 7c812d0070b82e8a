//! Conversations with frames of a device's own, on lines and on CAN.
