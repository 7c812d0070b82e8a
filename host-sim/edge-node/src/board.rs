//! Converts a Sparkplug file to settings for a board, in the format of `recipe_sparkplug::document`.

use std::path::Path;

use recipe_config::file::{SparkplugFile, load_sparkplug};
use recipe_sparkplug::document::{Host, MAX_DOCUMENT, MAX_HOST, NodeDocument};
use recipe_sparkplug::gateway::PublishRule;
use recipe_sparkplug::topic::Id;

use crate::file::settings_of;

/// Reads a Sparkplug file and its login file with user and password, and writes them as bytes for a board.
///
/// # Errors
/// The first mistake, or a setting that a board does not support, as one message with its place.
pub fn settings(path: &Path) -> Result<Vec<u8>, String> {
    let file = load_sparkplug(path, |name| Id::new(name).map(|_| ()).map_err(|error| error.to_string()));
    let file = file.map_err(|error| error.to_string())?;
    of(&file).map_err(|why| format!("{}: {why}", path.display()))
}

fn of(file: &SparkplugFile) -> Result<Vec<u8>, String> {
    if file.ca.is_some() {
        return Err("broker.ca: a board speaks no TLS; write plain = true instead, and let it tell only in a network \
                    of its own (docs/fleet.md section 6)"
            .into());
    }
    if file.bd_seq.is_some() {
        return Err("node.bd_seq: a board keeps the number of the session itself; leave this out".into());
    }
    let host = |key: &str, host: &str| {
        Host::try_from(host)
            .map_err(|_| format!("{key}: {} bytes; allowed on a board: {MAX_HOST}", host.len()))
    };
    let mut document = NodeDocument { settings: settings_of(file)?, ..NodeDocument::empty() };
    document.host = host("broker.address", &file.host)?;
    document.port = file.port;
    (document.sample, document.interval) = (file.sample, file.interval);
    document.counter_interval = file.counter_interval;
    document.time_server = match &file.time_server {
        Some((server, port)) => Some((host("time.server", server)?, *port)),
        None => None,
    };
    // The file allows no more than these.
    document.values = file.values.iter().copied().collect();
    document.rules = file
        .rules
        .iter()
        .map(|rule| PublishRule { vars: rule.values, dead_band: rule.dead_band, min_interval: rule.interval })
        .collect();
    let mut bytes = vec![0; MAX_DOCUMENT];
    let written =
        document.encode(&mut bytes).map_err(|error| format!("a board does not take this: {error}"))?;
    Ok(written.to_vec())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    fn made(broker: &str, node: &str, rest: &str) -> Result<NodeDocument, String> {
        let folder = tempfile::tempdir().unwrap();
        let login = folder.path().join("press.login");
        std::fs::write(&login, "press\ncold steel\n").unwrap();
        std::fs::set_permissions(&login, std::fs::Permissions::from_mode(0o600)).unwrap();
        let path = folder.path().join("sparkplug.toml");
        let toml = format!("[broker]\n{broker}\n[node]\ngroup = \"hall\"\nname = \"press\"\n{node}\n{rest}");
        std::fs::write(&path, toml).unwrap();
        let mut document = NodeDocument::empty();
        let tells = document.decode(&settings(&path)?).map_err(|error| error.to_string())?;
        assert!(tells);
        Ok(document)
    }

    #[test]
    fn a_file_becomes_settings() {
        let document = made(
            "address = \"10.0.0.5\"\nplain = true\nlogin = \"press.login\"",
            "primary_host = \"scada\"",
            "[report]\nvalues = [\"RobotState[1..6]\"]\n[[rule]]\nvalues = \"ForceEnd[1]\"\ndead_band = 0.5\n\
             [time]\nserver = \"10.0.0.1\"\n",
        );
        let document = document.unwrap();
        assert_eq!((document.host.as_str(), document.port), ("10.0.0.5", 1883));
        let server = document.time_server.map(|(host, port)| (host.as_str().to_owned(), port));
        assert_eq!(server, Some(("10.0.0.1".to_owned(), 123)));
        let (user, password) = document.settings.login.unwrap();
        assert_eq!((user.as_str(), password.as_str()), ("press", "cold steel"));
        assert_eq!(document.settings.primary_host.unwrap().as_str(), "scada");
        assert_eq!((document.values.len(), document.rules[0].dead_band), (1, 0.5));
    }

    #[test]
    fn what_a_board_has_not_is_said_with_its_key() {
        let plain = "address = \"b\"\nplain = true";
        for (broker, node, rest, expected) in [
            (
                "address = \"b\"\nca = \"ca.pem\"",
                "",
                "",
                "broker.ca: a board speaks no TLS; write plain = true",
            ),
            (plain, "bd_seq = \"n\"", "", "node.bd_seq: a board keeps the number"),
            ("address = \"[::1]\"\nplain = true", "", "", "the broker is out of range"),
            (plain, "", "[time]\nserver = \"a b\"", "time.server"),
        ] {
            let error = made(broker, node, rest).unwrap_err();
            assert!(error.contains(expected), "{error}");
        }
        let long = format!("address = \"{}\"\nplain = true", "b".repeat(129));
        assert!(
            made(&long, "", "").unwrap_err().contains("broker.address: 129 bytes; allowed on a board: 128")
        );
    }
}
