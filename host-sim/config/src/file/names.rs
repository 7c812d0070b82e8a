//! Suggestions for misspelled names: similar spellings, and the terms of other tools and manuals.
//!
//! In: a name in a file, and the known names. Out: the end of a message, empty if no name is similar.

use proto_core::sysvar::SysVar;

/// Suggests the nearest of `names` as `; did you mean "x"?`; empty if none is similar.
pub(super) fn did_you_mean<'n>(given: &str, names: impl Iterator<Item = &'n str>) -> String {
    let near = names.map(|name| (distance(given, name), name)).min();
    match near {
        Some((changes, name)) if changes <= 1 + given.chars().count() / 5 => ask(name),
        _ => String::new(),
    }
}

/// The number of wrong, missing, extra or swapped letters in a name. A missing unit counts as one mistake.
fn distance(given: &str, name: &str) -> usize {
    let whole = strsim::osa_distance(given, name);
    let bare = name.rsplit_once('_').filter(|(_, unit)| matches!(*unit, "ms" | "us"));
    bare.map_or(whole, |(bare, _)| whole.min(1 + strsim::osa_distance(given, bare)))
}

/// As [`did_you_mean`] for a key, which may have another name in other tools.
pub(super) fn meant_key(given: &str, names: &[&str]) -> String {
    let given_plain = plain(given);
    let is_alias = |(others, _): &&(&str, &str)| others.split(' ').any(|other| other == given_plain);
    if let Some((_, name)) = KEYS.iter().filter(is_alias).find(|(_, name)| names.contains(name)) {
        return ask(name);
    }
    // The controller's ports are in a table of their own.
    let service = given_plain.strip_suffix("port").filter(|_| names.contains(&"ports"));
    match service.filter(|service| matches!(*service, "command" | "state" | "modbus" | "udp2011")) {
        Some(service) => format!("; write ports = {{ {service} = ... }}"),
        None => did_you_mean(given, names.iter().copied()),
    }
}

/// As [`did_you_mean`] for the group of a system variable, in a name such as `RobotStat[8]`.
pub(super) fn meant_variable(given: &str) -> String {
    let pendant = given.strip_prefix("__").and_then(|rest| Some(rest.rsplit_once('_')?.0));
    let group = pendant.unwrap_or_else(|| given.split('[').next().unwrap_or(given));
    if SysVar::all().any(|var| var.group() == group) {
        return String::new();
    }
    did_you_mean(group, SysVar::all().map(SysVar::group))
}

/// As [`did_you_mean`] for the type of a field.
pub(super) fn meant_type(given: &str, names: &[&str]) -> String {
    meant(given, names, &TYPES)
}

/// As [`did_you_mean`] for a checksum.
pub(super) fn meant_checksum(given: &str, names: &[&str]) -> String {
    let given = plain(given);
    let bare = given.strip_prefix("crc").unwrap_or(&given);
    // `MODBUS`, `CRC-MODBUS` and `CCITT-FALSE` omit the beginning of the known names.
    let ends_so = |name: &str| {
        let (_, last) = name.split_once('-').unwrap_or((name, ""));
        !last.is_empty() && plain(last) == bare
    };
    match names.iter().find(|name| ends_so(name)) {
        Some(name) => ask(name),
        None => meant(&given, names, &CHECKSUMS),
    }
}

/// Suggests the name that differs only in punctuation and case, else the name with this alias, else the nearest name.
fn meant(given: &str, names: &[&str], aliases: &[(&str, &str)]) -> String {
    let given_plain = plain(given);
    if let Some(name) = names.iter().find(|name| plain(name) == given_plain) {
        return ask(name);
    }
    let alias = aliases.iter().find(|(others, _)| others.split(' ').any(|other| other == given_plain));
    match alias {
        Some((_, meant)) if names.contains(meant) => ask(meant),
        Some((_, meant)) => format!("; {meant}"),
        None => did_you_mean(given, names.iter().copied()),
    }
}

fn ask(name: &str) -> String {
    format!("; did you mean {name:?}?")
}

/// Reduces a name to its letters and digits, in lower case.
fn plain(name: &str) -> String {
    name.chars().filter(char::is_ascii_alphanumeric).map(|c| c.to_ascii_lowercase()).collect()
}

/// Names of the keys in other tools.
const KEYS: [(&str, &str); 7] = [
    ("baudrate bps bitrate speed", "baud"),
    ("baudrate baud bps speed", "bitrate"),
    ("ip ipaddress host hostname", "address"),
    ("header prefix start", "head"),
    ("trailer footer suffix end", "tail"),
    ("stopbit", "stop_bits"),
    ("extendedid isextended ext", "extended"),
];

/// Names of types in other tools, with the type here. If there is none or a name has several meanings: what to write.
const TYPES: [(&str, &str); 15] = [
    ("i8 int8 s8 sint signedchar", "char"),
    ("u8 uint8 usint unsignedchar octet", "byte"),
    ("i16 int16 s16 integer16", "short"),
    ("u16 uint16 ushort unsignedshort register", "word"),
    ("i24 s24", "int24"),
    ("u24", "uint24"),
    ("i32 int32 s32 dint long integer integer32", "int"),
    ("u32 uint32 udint ulong unsignedint unsignedlong", "dword"),
    ("u64 ulint ulonglong", "uint64"),
    ("f32 float32 real single real32", "float"),
    ("f64 float64 lreal real64", "double"),
    ("ascii number", "decimal"),
    ("uint unsigned", "write \"word\" for 16 bits, \"dword\" for 32"),
    (
        "i64 int64 lint longlong",
        "numbers of 8 bytes are read in halves, \"dword\" and \"int\", or by their bits",
    ),
    ("bool boolean bit bits", "write type = \"byte\", bits = 0 for a single bit"),
];

/// Names of the checksums in other tools.
const CHECKSUMS: [(&str, &str); 13] = [
    ("crc crc16 16", "write \"crc16-modbus\" or \"crc16-arc\", which differ in how they begin"),
    ("ibm crcibm crc16ibm crc16lha lha", "crc16-arc"),
    ("crc16rtu rtu modbusrtu", "crc16-modbus"),
    (
        "ccitt crcccitt crc16ccitt ccitt16",
        "write \"crc16-ccitt-false\", which begins with 0xFFFF, or \"crc16-xmodem\" or \"crc16-kermit\", which begin with 0",
    ),
    ("crc16ibm3740 ibm3740 autosar16 crc16autosar", "crc16-ccitt-false"),
    ("spifujitsu crc16spifujitsu augccitt crc16augccitt", "crc16-ccitt-aug"),
    ("zmodem crc16zmodem acorn crc16acorn", "crc16-xmodem"),
    ("ibmsdlc crc16ibmsdlc hdlc crc16hdlc", "crc16-x25"),
    ("zip crc32zip ethernet crc32ethernet isohdlc crc32isohdlc ieee crc32ieee", "crc32"),
    ("castagnoli iscsi crc32iscsi crc32castagnoli", "crc32c"),
    ("dallas crc8dallas 1wire onewire", "crc8-maxim"),
    ("sum checksum add add8 checksum8", "sum8"),
    ("xor bcc nmea", "xor8"),
];

#[cfg(test)]
mod tests {
    use proto_core::device::Algorithm;

    use super::*;

    #[test]
    fn keys_are_known_by_their_other_names() {
        let line = ["name", "bus", "baud", "parity", "stop_bits", "timeout_ms"];
        let controller = ["address", "dialect", "ports", "recipe_link"];
        for (given, names, said) in [
            ("baudrate", &line[..], "; did you mean \"baud\"?"),
            ("baud_rate", &line, "; did you mean \"baud\"?"),
            ("timeout", &line, "; did you mean \"timeout_ms\"?"),
            ("baudrate", &["bus", "bitrate"], "; did you mean \"bitrate\"?"),
            ("modbus_port", &controller, "; write ports = { modbus = ... }"),
            ("modbus_port", &line, ""),
            ("ip", &controller, "; did you mean \"address\"?"),
            ("ip", &line, ""),
        ] {
            assert_eq!(meant_key(given, names), said, "{given}");
        }
    }

    #[test]
    fn checksums_are_known_by_their_other_names() {
        let checksums: Vec<_> = Algorithm::names().collect();
        for (given, meant) in [
            ("CRC16_MODBUS", "crc16-modbus"),
            ("CRC-16/MODBUS", "crc16-modbus"),
            ("modbus", "crc16-modbus"),
            ("Modbus-RTU", "crc16-modbus"),
            ("CCITT-FALSE", "crc16-ccitt-false"),
            ("CRC-CCITT-FALSE", "crc16-ccitt-false"),
            ("CRC-16/IBM-3740", "crc16-ccitt-false"),
            ("x-25", "crc16-x25"),
            ("SAE J1850", "crc8-sae-j1850"),
            ("CRC-8", "crc8"),
            ("CRC-32", "crc32"),
            ("crc-32c", "crc32c"),
            ("BCC", "xor8"),
            ("checksum", "sum8"),
            ("crc16-modbuss", "crc16-modbus"),
        ] {
            let said = meant_checksum(given, &checksums);
            assert_eq!(said, format!("; did you mean {meant:?}?"), "{given}");
        }
        assert!(meant_checksum("CRC-16", &checksums).contains("\"crc16-modbus\" or \"crc16-arc\""));
        assert_eq!(meant_checksum("fletcher", &checksums), "");
    }

    #[test]
    fn types_are_known_by_their_other_names() {
        let names = ["byte", "char", "word", "short", "dword", "int", "float", "double", "uint24", "uint64"];
        for (given, meant) in [
            ("int16", "short"),
            ("UINT16", "word"),
            ("u8", "byte"),
            ("int32", "int"),
            ("REAL", "float"),
            ("float64", "double"),
            ("shrt", "short"),
            ("Word", "word"),
        ] {
            let said = meant_type(given, &names);
            assert_eq!(said, format!("; did you mean {meant:?}?"), "{given}");
        }
        assert!(meant_type("bool", &names).contains("bits = 0"));
        assert_eq!(meant_type("colour", &names), "");
    }

    /// Every checksum of the table is one that there is, or a sentence.
    #[test]
    fn what_the_tables_say_exists() {
        for (others, meant) in CHECKSUMS {
            let exists = Algorithm::named(meant).is_some() || meant.starts_with("write ");
            assert!(exists, "{meant}");
            assert!(others.split(' ').all(|other| plain(other) == other), "{others}");
        }
        assert!(TYPES.iter().all(|(others, _)| others.split(' ').all(|other| plain(other) == other)));
    }
}
