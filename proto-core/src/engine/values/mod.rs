//! The value, age, owner and safe value of every variable, and what is still to be written.

pub(crate) mod bits;
pub(crate) mod confirmed;
pub(crate) mod counts;
pub(crate) mod outbox;
pub(crate) mod rejected;
pub(crate) mod store;
pub(crate) mod withheld;
