//! An inventory: the gateways that a person looks after.
//!
//! In: a TOML file with `[[gateway]]`. Out: names, addresses and key files. Does not know the form of an address. Keys
//! are files, never text in the inventory.

use std::path::{Path, PathBuf};

use super::document::SourceTree;
use super::error::FileError;
use super::reader::{Result, TableReader, TableValue};
use super::{Text, with_text};
use crate::keys::inventory::{ADDRESS, FILE, GATEWAY, HOST, KEY, NAME};

/// One gateway of an inventory.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Listed {
    /// Its name, unique in the file.
    pub name: String,
    /// Its address.
    pub address: String,
    /// The address that the gateway knows itself by, if it is different, as behind a forwarded port.
    pub host: Option<String>,
    /// The file with its key, relative to the inventory's folder; `None` for read-only access.
    pub key: Option<PathBuf>,
}

const MAX: usize = 10_000;

/// Reads an inventory. `check` returns what is wrong with an address, and is also called for `host`.
///
/// # Errors
/// The first mistake, with its place.
pub fn load_inventory(
    path: &Path,
    check: impl Fn(&str) -> std::result::Result<(), String>,
) -> Result<Vec<Listed>> {
    let folder = path.parent().unwrap_or(Path::new("")).to_owned();
    let mut listed = with_text(path, |text| parse_inventory(text, &check))?;
    for gateway in &mut listed {
        gateway.key = gateway.key.take().map(|key| folder.join(key));
    }
    Ok(listed)
}

/// As [`load_inventory`], from a text; the paths of key files stay as they are.
///
/// # Errors
/// The first mistake, with its place.
pub fn parse_inventory(
    text: Text<'_>,
    check: impl Fn(&str) -> std::result::Result<(), String>,
) -> Result<Vec<Listed>> {
    let document = SourceTree::parse(text.name, text.toml, &[])?;
    let root = TableReader::root(&document, &FILE)?;
    let tables = root.any_tables("gateway")?;
    if tables.is_empty() {
        return Err(document.whole_file_error("no gateway; write [[gateway]] with name and address"));
    }
    if tables.len() > MAX {
        return Err(document.whole_file_error(format!("{} gateways; allowed: {MAX}", tables.len())));
    }
    let mut listed: Vec<Listed> = Vec::new();
    for table in tables {
        table.check(&GATEWAY)?;
        let name_item = table.required(NAME.name, "a name of your own")?;
        let name = text_of(&name_item, 64)?;
        if listed.iter().any(|other| other.name == name) {
            return Err(name_item.error(format!("{name:?} is the name of another gateway of this file")));
        }
        let address_item = table.required(ADDRESS.name, "such as \"192.168.0.20\"")?;
        let address = text_of(&address_item, 255)?;
        check(&address).map_err(|why| address_item.error(why))?;
        let host = table.optional(HOST.name).map(|item| {
            let host = text_of(&item, 255)?;
            check(&host).map_err(|why| item.error(why))?;
            Ok::<_, FileError>(host)
        });
        let host = host.transpose()?;
        let key = table.optional(KEY.name).map(|item| text_of(&item, 4_096)).transpose()?;
        listed.push(Listed { name, address, host, key: key.map(PathBuf::from) });
    }
    Ok(listed)
}

/// A text of at least one character and at most `max` bytes.
pub(super) fn text_of(item: &TableValue<'_>, max: usize) -> std::result::Result<String, FileError> {
    let text = item.string()?;
    match text.len() {
        0 => Err(item.error("empty")),
        len if len > max => Err(item.error(format!("{len} bytes; allowed: {max}"))),
        _ if text.contains(char::is_control) => Err(item.error("control characters are not allowed")),
        _ => Ok(text.to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(toml: &str) -> std::result::Result<Vec<Listed>, String> {
        let check = |address: &str| match address {
            "bad" => Err("\"bad\" is not an address".to_owned()),
            _ => Ok(()),
        };
        parse_inventory(Text { name: "cells.toml", toml }, check).map_err(|error| error.to_string())
    }

    #[test]
    fn gateways_are_listed_in_their_order() {
        let listed = read(
            "[[gateway]]\nname = \"press\"\naddress = \"10.0.0.2\"\nkey = \"press.key\"\n[[gateway]]\nname = \"saw\"\naddress = \"saw:81\"\nhost = \"10.0.2.15\"\n",
        )
        .unwrap();
        let shown: Vec<_> = listed.iter().map(|one| (&*one.name, &*one.address, one.key.is_some())).collect();
        assert_eq!(shown, [("press", "10.0.0.2", true), ("saw", "saw:81", false)]);
        let hosts: Vec<_> = listed.iter().map(|one| one.host.as_deref()).collect();
        assert_eq!(hosts, [None, Some("10.0.2.15")]);
    }

    #[test]
    fn a_mistake_has_its_place_and_says_what_is_allowed() {
        let gateway = |more: &str| format!("[[gateway]]\nname = \"a\"\naddress = \"b\"\n{more}");
        for (toml, expected) in [
            (String::new(), "cells.toml: no gateway; write [[gateway]] with name and address"),
            ("[[gatway]]\n".into(), "cells.toml:1:3: gatway: unknown key; allowed: gateway; did you mean"),
            (
                gateway("adress = 1"),
                "cells.toml:4:1: gateway.a.adress: unknown key of a gateway; allowed: name, address, host, key; did you mean \"address\"?",
            ),
            ("[[gateway]]\nname = \"a\"\n".into(), "cells.toml:1:1: gateway.a: address is missing; such as"),
            ("[[gateway]]\naddress = \"a\"\n".into(), "cells.toml:1:1: gateway[1]: name is missing"),
            (gateway("key = 3"), "cells.toml:4:7: gateway.a.key: expected a string, found an integer"),
            (gateway("key = \"\""), "cells.toml:4:7: gateway.a.key: empty"),
            (
                gateway("[[gateway]]\nname = \"a\"\naddress = \"c\""),
                "cells.toml:5:8: gateway.a.name: \"a\" is the name of another",
            ),
            (
                "[[gateway]]\nname = \"a\"\naddress = \"bad\"".into(),
                "cells.toml:3:11: gateway.a.address: \"bad\" is not an address",
            ),
            (gateway("host = \"bad\""), "cells.toml:4:8: gateway.a.host: \"bad\" is not an address"),
            (gateway("host = \"\""), "cells.toml:4:8: gateway.a.host: empty"),
            ("gateway = 3".into(), "cells.toml:1:11: gateway: expected an array of tables"),
        ] {
            let error = read(&toml).unwrap_err();
            assert!(error.starts_with(expected), "{error}\n{expected}");
        }
    }
}
