//! The 1468-byte state packet of port 2001.
