//! A board in QEMU with a store, a button and a client.

use std::net::TcpListener;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use recipe_api::key::Key;
use recipe_test_kit::http::{Client, Response};
use recipe_test_kit::until;
use serde_json::Value;
use tempfile::TempDir;

pub(crate) const KEY: &str = "00112233445566778899aabbccddeeff";
/// The address that QEMU's user network gives the board.
const BOARD: &str = "10.0.2.15";
const NO_IMAGE: &str = "/nowhere/cell.img";
/// Repeated in full, so that what tests look for in the log is a text of the firmware.
const PRESSED: &str = "the button was pressed: a key is taken for 60 s";

/// The board, its files, and how to reach it.
pub(crate) struct QemuBoard {
    qemu: Option<Child>,
    pub(crate) folder: TempDir,
    pub(crate) client: Client,
    image: PathBuf,
}

impl QemuBoard {
    /// Starts one with this configuration and an empty store.
    pub(crate) fn new(toml: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let image = make_image(folder.path(), "first", toml);
        Self::with_image(folder, image)
    }

    /// Starts one without a configuration.
    pub(crate) fn empty() -> Self {
        Self::with_image(tempfile::tempdir().unwrap(), NO_IMAGE.into())
    }

    fn with_image(folder: TempDir, image: PathBuf) -> Self {
        // Free at the moment; nobody else asks for it by number.
        let to = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let client = Client { to, host: BOARD.to_owned(), key: None };
        let mut board = Self { qemu: None, folder, client, image };
        board.start();
        board
    }

    /// One that has the key already.
    pub(crate) fn claimed(toml: &str) -> Self {
        let mut board = Self::new(toml);
        board.claim();
        board
    }

    /// Switches it off and on, without the file of the first image.
    pub(crate) fn power_cycle(&mut self) {
        self.switch_off();
        self.image = NO_IMAGE.into();
        self.start();
    }

    fn switch_off(&mut self) {
        if let Some(mut qemu) = self.qemu.take() {
            qemu.kill().unwrap();
            qemu.wait().unwrap();
        }
    }

    fn start(&mut self) {
        let path = |name: &str| self.folder.path().join(name).display().to_string();
        let _ = std::fs::remove_file(path("log"));
        let network = format!("user,hostfwd=tcp:{}-:80", self.client.to);
        let arguments = format!(
            "enable=on,target=native,arg=firmware,arg={},arg=none,arg={},arg={}",
            self.image.display(),
            path("store"),
            path("button")
        );
        let line = format!("unix:{},server=on,wait=off", path("line"));
        let log = format!("file:{}", path("log"));
        let qemu = Command::new("qemu-system-arm")
            .args("-M mps2-an500 -display none -monitor none".split(' '))
            .args(["-nic", &network, "-serial", &line, "-serial", "null", "-serial", "null", "-serial", &log])
            .args(["-semihosting-config", &arguments, "-kernel"])
            .arg(variable("FIRMWARE_ELF"))
            .stdin(Stdio::null())
            .spawn();
        self.qemu = Some(qemu.expect("qemu-system-arm runs"));
        self.until_log("address ");
        self.until_reached();
    }

    /// Waits until it answers; its network is there a little before.
    pub(crate) fn until_reached(&self) {
        until("the board is reached", || self.client.try_request("GET /api/v1/nonce", "", b""));
    }

    /// Presses the button and gives it the key.
    pub(crate) fn claim(&mut self) {
        self.press();
        let body = format!("{{\"key\": \"{KEY}\"}}");
        self.client
            .request("POST /api/v1/claim", "Content-Type: application/json", body.as_bytes())
            .must_be(200);
        self.client.key = Key::parse(KEY);
    }

    /// Presses the button, until the board has noticed.
    pub(crate) fn press(&self) {
        let button = self.folder.path().join("button");
        std::fs::write(&button, "").unwrap();
        until("the button is noticed", || self.log().contains(PRESSED).then_some(()));
        std::fs::remove_file(&button).unwrap();
    }

    pub(crate) fn log(&self) -> String {
        std::fs::read_to_string(self.folder.path().join("log")).unwrap_or_default()
    }

    #[track_caller]
    pub(crate) fn until_log(&self, text: &str) {
        let found = || self.log().contains(text).then_some(());
        until(&format!("{text:?} in {}", self.folder.path().join("log").display()), found);
    }

    /// The first RS-485 line.
    pub(crate) fn line(&self) -> UnixStream {
        UnixStream::connect(self.folder.path().join("line")).unwrap()
    }

    pub(crate) fn revisions(&self) -> Value {
        self.client.get("revisions").must_be(200).json()
    }

    /// Waits until the revisions are like this; the board may be restarting.
    #[track_caller]
    pub(crate) fn until_revisions(&self, what: &str, found: impl Fn(&Value) -> bool) -> Value {
        until(what, || Some(self.client.try_get("revisions")?.json()).filter(&found))
    }

    /// Stores the image of a configuration, and returns the number of its revision.
    #[track_caller]
    pub(crate) fn put(&self, toml: &str) -> u64 {
        let image = std::fs::read(make_image(self.folder.path(), "next", toml)).unwrap();
        let stored = self.put_image(&image).must_be(201);
        stored.json()["revision"].as_u64().unwrap()
    }

    /// Sends an image.
    #[track_caller]
    pub(crate) fn put_image(&self, image: &[u8]) -> Response {
        let base = self.revisions()["base"].as_str().unwrap().to_owned();
        let fields = format!("Content-Type: application/octet-stream\nIf-Match: {base}");
        self.client.signed("PUT /api/v1/config", &fields, image)
    }
}

impl Drop for QemuBoard {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("the board's log:\n{}", self.log());
        }
        self.switch_off();
    }
}

/// A configuration whose panel on the first line sends its outputs; `timeout_ms` tells one from another.
pub(crate) fn panel(timeout_ms: u32) -> String {
    recipe_test_kit::toml::panel("1 = \"stop\"", timeout_ms)
}

/// The image of a configuration.
#[track_caller]
pub(crate) fn make_image(folder: &Path, name: &str, toml: &str) -> PathBuf {
    let (file, image) = (folder.join(format!("{name}.toml")), folder.join(format!("{name}.img")));
    std::fs::write(&file, toml).unwrap();
    let made = Command::new(variable("HOST_SIM"))
        .arg("image")
        .arg(&file)
        .args(["--set", "controller.address=10.0.2.2", "-o"])
        .arg(&image)
        .output()
        .unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    image
}

pub(crate) fn variable(name: &str) -> PathBuf {
    let value = std::env::var_os(name).unwrap_or_else(|| panic!("{name} is not set; see the top of main.rs"));
    // Relative to the workspace: Cargo runs tests in the package's folder.
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(value)
}
