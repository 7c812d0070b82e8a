//! Captures and recordings of what goes over the gateway's ports and links.
#![forbid(unsafe_code)]
