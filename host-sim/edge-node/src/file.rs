//! A Sparkplug file, the files that it names, and what a node and its driver need of them.

use std::path::{Path, PathBuf};
use std::time::Duration;

use recipe_config::file::{SparkplugFile, load_sparkplug};
use recipe_io::files::{Beside, read_private};
use recipe_sparkplug::gateway::{PublishRule, Rates};
use recipe_sparkplug::node::{Credential, Settings};
use recipe_sparkplug::topic::Id;

use crate::broker::Broker;

/// The validated contents of a Sparkplug file.
#[derive(Debug, Clone)]
pub struct PublisherConfig {
    /// The broker.
    pub broker: Broker,
    /// The names of the node, and its MQTT settings.
    pub settings: Settings,
    /// The time between two samples of the gateway.
    pub sample: Duration,
    /// The file that stores the number of the session.
    pub bd_seq: Option<PathBuf>,
    rules: Vec<PublishRule>,
    file: SparkplugFile,
}

impl PublisherConfig {
    /// Reads a Sparkplug file, and the files that it names.
    ///
    /// # Errors
    /// The first mistake, as one message with its place.
    pub fn load(path: &Path) -> Result<Self, String> {
        let file = load_sparkplug(path, |name| Id::new(name).map(|_| ()).map_err(|error| error.to_string()));
        let file = file.map_err(|error| error.to_string())?;
        let of_file = |why: String| format!("{}: {why}", path.display());
        let broker = match &file.ca {
            Some(ca) => Broker::with_tls(&file.host, file.port, ca),
            None => Ok(Broker::plain(&file.host, file.port)),
        };
        let broker = broker.map_err(|why| of_file(format!("broker.ca: {why}")))?;
        if file.time_server.is_some() {
            return Err(of_file("time.server: for a board; the clock here is set by the system".into()));
        }
        let settings = settings_of(&file).map_err(of_file)?;
        if let Some(kept) = &file.bd_seq {
            // So that a mistake in the file is reported before anything runs.
            read_bd_seq(kept).map_err(|why| of_file(format!("node.bd_seq: {why}")))?;
        }
        let rules = file.rules.iter().map(|rule| PublishRule {
            vars: rule.values,
            dead_band: rule.dead_band,
            min_interval: rule.interval,
        });
        let sample = Duration::from_micros(file.sample.as_micros());
        Ok(Self { broker, settings, sample, bd_seq: file.bd_seq.clone(), rules: rules.collect(), file })
    }

    /// When changes are published.
    pub fn rates(&self) -> Rates<'_> {
        Rates {
            min_interval: self.file.interval,
            counter_interval: self.file.counter_interval,
            rules: &self.rules,
            values: &self.file.values,
        }
    }
}

/// The settings of a file's node, with the login if there is one.
pub(crate) fn settings_of(file: &SparkplugFile) -> Result<Settings, String> {
    let id = |name: &str| Id::new(name).map_err(|error| error.to_string());
    let mut settings = Settings::new(id(&file.group)?, id(&file.node)?);
    settings.primary_host = file.primary_host.as_deref().map(id).transpose()?;
    settings.keep_alive = file.keep_alive;
    if let Some(client_id) = file.client_id.as_deref().and_then(Credential::new) {
        settings.client_id = client_id;
    }
    let login = file.login.as_deref();
    settings.login =
        login.map(|login| read_login(login).map_err(|why| format!("broker.login: {why}"))).transpose()?;
    Ok(settings)
}

/// Reads a file with two lines, user and password, which only its owner may be able to read.
///
/// # Errors
/// What is wrong with the file, without repeating its contents.
pub fn read_login(path: &Path) -> Result<(Credential, Credential), String> {
    let refused = |why: &str| format!("{}: {why}", path.display());
    let text = read_private(path, 1_000).map_err(|error| refused(&error.to_string()))?;
    let mut lines = text.lines();
    let (Some(user @ [_, ..]), Some(password), None | Some("")) =
        (lines.next().map(str::as_bytes), lines.next(), lines.next())
    else {
        return Err(refused("not two lines, user and password"));
    };
    let user = std::str::from_utf8(user).ok().and_then(Credential::new);
    user.zip(Credential::new(password)).ok_or_else(|| refused("a line is longer than 129 bytes"))
}

/// Reads the number of the last session; `None` if there was none.
///
/// # Errors
/// What is wrong with the file.
pub fn read_bd_seq(path: &Path) -> Result<Option<u8>, String> {
    match std::fs::read_to_string(path) {
        Ok(text) => match text.trim().parse() {
            Ok(number) => Ok(Some(number)),
            Err(_) => Err(format!("{}: not a number of 0..=255", path.display())),
        },
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(format!("{}: {error}", path.display())),
    }
}

/// Stores the number of a session atomically: the file has either the old or the new number.
pub fn write_bd_seq(path: &Path, number: u8) -> std::io::Result<()> {
    Beside::file(path, format!("{number}\n").as_bytes())?.0.replace(path)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn a_login_is_two_lines_and_its_owners_alone() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("login");
        let read = |text: &str, mode| {
            std::fs::write(&path, text).unwrap();
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).unwrap();
            read_login(&path).map(|(user, password)| (user.as_str().to_owned(), password.as_str().to_owned()))
        };
        assert_eq!(read("press\nse cret\n", 0o600), Ok(("press".into(), "se cret".into())));
        assert!(read("press\nsecret\n", 0o644).unwrap_err().contains("0644"));
        for wrong in ["", "press", "\nsecret", "a\nb\nc\n", &format!("press\n{}", "x".repeat(130))] {
            let error = read(wrong, 0o600).unwrap_err();
            assert!(!error.contains("secret"), "{error}");
        }
    }

    #[test]
    fn the_number_of_a_session_is_kept() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("bdseq");
        assert_eq!(read_bd_seq(&path), Ok(None));
        write_bd_seq(&path, 255).unwrap();
        write_bd_seq(&path, 7).unwrap();
        assert_eq!(read_bd_seq(&path), Ok(Some(7)));
        std::fs::write(&path, "256").unwrap();
        assert!(read_bd_seq(&path).unwrap_err().ends_with("not a number of 0..=255"));
    }

    #[test]
    fn files_that_a_file_names_are_read_before_anything_runs() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("sparkplug.toml");
        let load = |more: &str| {
            let toml =
                format!("[broker]\naddress = \"b\"\n{more}\n[node]\ngroup = \"hall\"\nname = \"press\"\n");
            std::fs::write(&path, toml).unwrap();
            PublisherConfig::load(&path).map(|config| config.broker.address())
        };
        assert_eq!(load("plain = true"), Ok("b:1883".into()));
        let of_a_board = load("plain = true\n[time]\nserver = \"10.0.0.1\"");
        assert!(of_a_board.unwrap_err().contains("time.server: for a board"));
        assert!(load("ca = \"none.pem\"").unwrap_err().contains("broker.ca: "));
        std::fs::write(folder.path().join("empty.pem"), "").unwrap();
        assert!(load("ca = \"empty.pem\"").unwrap_err().ends_with("no certificate in it; allowed: PEM"));
        assert!(load("plain = true\nlogin = \"none\"").unwrap_err().contains("broker.login: "));
    }
}
