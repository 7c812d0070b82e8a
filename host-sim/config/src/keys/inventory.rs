//! The keys of an inventory.

use super::{Key, KeyTable, Shape, TextKind};

pub(crate) const NAME: Key =
    Key::text_of("name", TextKind::Length(1, 64)).required().is("a name of your own, unique");
pub(crate) const ADDRESS: Key =
    Key::text_of("address", TextKind::Length(1, 255)).required().is("where it is, with or without a port");
pub(crate) const HOST: Key = Key::text_of("host", TextKind::Length(1, 255))
    .absent("it is `address`")
    .is("the address that it knows itself by, if `address` is a forwarded port");
pub(crate) const KEY: Key = Key::text_of("key", TextKind::Length(1, 4_096))
    .absent("it is only read")
    .is("the file with its key, relative to the inventory");

/// `[[gateway]]`.
pub const GATEWAY: KeyTable = KeyTable::of("listed gateway", &[NAME, ADDRESS, HOST, KEY]).at(" of a gateway");

/// The file.
pub const FILE: KeyTable = KeyTable::of(
    "inventory file",
    &[Key::new("gateway", Shape::List(&Shape::Table(&GATEWAY), 1, 10_000)).required().is("the gateways")],
);
