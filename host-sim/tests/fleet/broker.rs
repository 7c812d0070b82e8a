//! Debian's mosquitto as a plant runs it: TLS, passwords, rules of who may do what.

use std::net::{TcpListener, TcpStream};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use recipe_test_kit::{Process, until};
use tempfile::TempDir;

/// A folder with everything that brokers and clients need, made anew for each test.
pub(crate) struct Plant {
    folder: TempDir,
    port: u16,
}

/// How clients speak to the broker.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Way {
    Tls,
    Plain,
}

const RULES: &str = "\
user press
topic write spBv1.0/hall/+/press
topic write spBv1.0/hall/+/press/+
topic read spBv1.0/hall/NCMD/press
topic read spBv1.0/STATE/scada

user scada
topic readwrite spBv1.0/#
";

impl Plant {
    pub(crate) fn new(way: Way) -> Self {
        // Free now; nobody else takes it before the broker does, or the test says so.
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let plant = Self { folder: tempfile::tempdir().unwrap(), port };
        for (user, password) in [("press", "cold steel"), ("scada", "all eyes")] {
            let file = plant.path("passwords");
            let mut command = Command::new("mosquitto_passwd");
            if !file.exists() {
                command.arg("-c");
            }
            run(command.arg("-b").arg(&file).args([user, password]));
            plant.write(&format!("{user}.login"), &format!("{user}\n{password}\n"));
        }
        plant.write("rules", RULES);
        let mut config = format!(
            "listener {port} 127.0.0.1\nallow_anonymous false\npassword_file {}\nacl_file {}\n",
            plant.path("passwords").display(),
            plant.path("rules").display(),
        );
        // Only started by root it would take another user, who cannot read the folder.
        config += "user root\npersistence false\nlog_dest stderr\n";
        if way == Way::Tls {
            plant.make_certificates();
            let (ca, own, key) = (plant.path("ca.pem"), plant.path("server.pem"), plant.path("server.key"));
            let (ca, own, key) = (ca.display(), own.display(), key.display());
            config += &format!("cafile {ca}\ncertfile {own}\nkeyfile {key}\n");
        }
        plant.write("mosquitto.conf", &config);
        plant
    }

    /// An authority, another one that nobody trusts, and the broker's certificate by the first.
    fn make_certificates(&self) {
        let curve = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"];
        for name in ["ca", "other"] {
            let mut command = self.openssl(&["req", "-x509", "-days", "2", "-subj"]);
            command.arg(format!("/CN={name} of the plant")).args(curve);
            run(command.args(["-keyout", &format!("{name}.key"), "-out", &format!("{name}.pem")]));
        }
        let mut command = self.openssl(&["req", "-subj", "/CN=broker"]);
        run(command.args(curve).args(["-keyout", "server.key", "-out", "server.csr"]));
        self.write("names", "subjectAltName=DNS:localhost,IP:127.0.0.1\n");
        run(&mut self.openssl(&[
            "x509",
            "-req",
            "-days",
            "2",
            "-in",
            "server.csr",
            "-CA",
            "ca.pem",
            "-CAkey",
            "ca.key",
            "-CAcreateserial",
            "-extfile",
            "names",
            "-out",
            "server.pem",
        ]));
    }

    fn openssl(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new("openssl");
        command.current_dir(self.folder.path()).args(arguments);
        command
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Writes a file that nobody else can read.
    pub(crate) fn write(&self, name: &str, text: &str) -> PathBuf {
        let path = self.path(name);
        std::fs::write(&path, text).unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600)).unwrap();
        path
    }

    pub(crate) fn port(&self) -> u16 {
        self.port
    }

    /// Starts the broker and waits until it listens.
    #[track_caller]
    pub(crate) fn broker(&self) -> Process {
        let mut command = Command::new("mosquitto");
        command.arg("-c").arg(self.path("mosquitto.conf"));
        let broker = Process::start(piped(&mut command));
        until("the broker listens", || TcpStream::connect(("127.0.0.1", self.port)).ok());
        broker
    }

    /// The Sparkplug file of the node `press`, with other lines of `[broker]`, `[node]` and behind.
    pub(crate) fn sparkplug(&self, broker: &str, node: &str, rest: &str) -> PathBuf {
        self.write(
            "sparkplug.toml",
            &format!(
                "[broker]\naddress = \"localhost:{}\"\nkeep_alive_s = 5\n{broker}\n\
                 [node]\ngroup = \"hall\"\nname = \"press\"\n{node}\n\
                 [report]\nsample_ms = 100\ninterval_ms = 100\ncounter_interval_ms = 2000\n{rest}\n",
                self.port
            ),
        )
    }

    /// A client of mosquitto's as the user `scada`.
    pub(crate) fn client(&self, program: &str) -> Command {
        // Each line at once, though nobody is at a terminal.
        let mut command = Command::new("stdbuf");
        command.args(["-oL", program]);
        command.args(["-h", "localhost", "-p", &self.port.to_string(), "-u", "scada", "-P", "all eyes"]);
        let ca = self.path("ca.pem");
        if ca.exists() {
            command.arg("--cafile").arg(ca);
        }
        piped(&mut command);
        command
    }

    /// Publishes a message.
    pub(crate) fn publish(&self, topic: &str, is_retained: bool, payload: &[u8]) {
        let file = self.path("payload");
        std::fs::write(&file, payload).unwrap();
        let mut command = self.client("mosquitto_pub");
        command.args(["-t", topic, "-q", "1", "-f"]).arg(&file);
        if is_retained {
            command.arg("-r");
        }
        run(&mut command);
    }
}

fn piped(command: &mut Command) -> &mut Command {
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped())
}

#[track_caller]
fn run(command: &mut Command) {
    let output = command.output().unwrap_or_else(|error| panic!("{command:?}: {error}"));
    assert!(output.status.success(), "{command:?}: {}", String::from_utf8_lossy(&output.stderr));
}

/// Whether a file exists and is not empty.
pub(crate) fn is_written(path: &Path) -> bool {
    std::fs::metadata(path).is_ok_and(|file| file.len() > 0)
}
