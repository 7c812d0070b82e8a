//! `extcap`: Wireshark lists running gateways among its interfaces, and captures from them.
//!
//! In: the arguments that Wireshark gives to a program in its folder of extcap programs. Out: what it asks for, as it
//! wants to have it; or a capture into its pipe, which is that of the gateway's API. The gateway is found by its ready
//! file, which says where its console listens.

use std::fs::{self, File};
use std::io::{self, BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use recipe_runtime::out::{Out, Printed, is_broken_pipe};
use serde_json::Value;

use super::wrong;

/// Arguments of `extcap`, as Wireshark gives them.
#[derive(Debug, Args)]
pub(super) struct ExtcapArgs {
    /// List the interfaces
    #[arg(long, group = "what")]
    extcap_interfaces: bool,
    /// List the link types of an interface
    #[arg(long, group = "what", requires = "extcap_interface")]
    extcap_dlts: bool,
    /// List the options of an interface
    #[arg(long, group = "what", requires = "extcap_interface")]
    extcap_config: bool,
    /// Capture into --fifo until that is closed
    #[arg(long, group = "what", requires = "extcap_interface", requires = "fifo")]
    capture: bool,
    /// The interface: rgw
    #[arg(long, value_name = "NAME")]
    extcap_interface: Option<String>,
    /// Wireshark's version
    #[arg(long, value_name = "VERSION", num_args = 0..=1)]
    extcap_version: Option<Option<String>>,
    /// Wireshark's capture filter; ignored
    #[arg(long, value_name = "FILTER")]
    extcap_capture_filter: Option<String>,
    /// The pipe to write the capture to
    #[arg(long, value_name = "FILE")]
    fifo: Option<PathBuf>,
    /// The gateway's ready file [env: RGW_READY]
    #[arg(long, value_name = "FILE")]
    ready: Option<PathBuf>,
    /// Only frames of this port
    #[arg(long, value_name = "NAME")]
    port: Option<String>,
}

pub(super) const EXAMPLES: &str = "\
Wireshark runs this command. Install it once:
  ln -s \"$(command -v host-sim)\" ~/.local/lib/wireshark/extcap/host-sim-extcap
Then start the gateway with its API, and name its ready file:
  host-sim gateway -c cell.toml --bind hand=socketcan:can0 --console 127.0.0.1:0 \\
      --ready run/ready.json
  RGW_READY=run/ready.json wireshark

Examples, as Wireshark runs it:
  host-sim extcap --extcap-interfaces
  host-sim extcap --capture --extcap-interface rgw --fifo PIPE --ready run/ready.json";

/// The name of the program under which it is `extcap` without that word.
pub(super) const PROGRAM: &str = "host-sim-extcap";

const INTERFACE: &str = "rgw";

pub(super) fn run<W: Write>(args: &ExtcapArgs, mut out: Out<W>) -> ExitCode {
    let ready = args.ready.clone().or_else(|| std::env::var_os("RGW_READY").map(PathBuf::from));
    if args.extcap_interface.as_deref().is_some_and(|name| name != INTERFACE) {
        return wrong(format!("there is no interface {:?}; there is {INTERFACE}", args.extcap_interface));
    }
    let text = if args.capture {
        let Some(fifo) = &args.fifo else { return wrong("--capture needs --fifo") };
        return match capture(ready.as_deref(), args.port.as_deref(), fifo) {
            Ok(()) => ExitCode::SUCCESS,
            Err(message) => wrong(message),
        };
    } else if args.extcap_dlts {
        "dlt {number=147}{name=USER0}{display=Recipe gateway}\n".to_owned()
    } else if args.extcap_config {
        let ready = ready.map(|path| format!("{{default={}}}", path.display())).unwrap_or_default();
        format!(
            "arg {{number=0}}{{call=--ready}}{{display=Ready file}}{{type=fileselect}}{{mustexist=true}}{ready}\
             {{tooltip=The file that the gateway was given with --ready}}\n\
             arg {{number=1}}{{call=--port}}{{display=Port}}{{type=string}}\
             {{tooltip=Only this port; empty for all}}\n"
        )
    } else {
        format!(
            "extcap {{version={}}}{{display=Recipe gateway}}\ninterface {{value={INTERFACE}}}{{display=Recipe gateway}}\n",
            env!("CARGO_PKG_VERSION")
        )
    };
    let _ = out.write_all(text.as_bytes());
    out.finish(|_: Printed| ExitCode::SUCCESS)
}

/// Copies the gateway's capture into Wireshark's pipe, until one of them ends.
fn capture(ready: Option<&Path>, port: Option<&str>, fifo: &Path) -> Result<(), String> {
    let ready = ready.ok_or("--ready FILE is needed: the ready file of a gateway with --console")?;
    let console = console_of(ready)?;
    let refused = |error: io::Error| format!("the gateway at {console}: {error}");
    let mut stream = TcpStream::connect(&console).map_err(refused)?;
    stream.set_read_timeout(Some(ANSWER_TIMEOUT)).map_err(refused)?;
    let query = port.filter(|port| !port.is_empty()).map(|port| format!("?port={}", quoted(port)));
    let request = format!(
        "GET /api/v1/capture.pcapng{} HTTP/1.1\r\nHost: {console}\r\nConnection: close\r\n\r\n",
        query.unwrap_or_default()
    );
    stream.write_all(request.as_bytes()).map_err(refused)?;
    let mut body =
        ChunkedBody::read_head(BufReader::new(stream.try_clone().map_err(refused)?)).map_err(refused)?;
    // Frames may be rare.
    stream.set_read_timeout(None).map_err(refused)?;
    let mut pipe = File::options()
        .write(true)
        .open(fifo)
        .map_err(|error| format!("--fifo {}: {error}", fifo.display()))?;
    let mut bytes = vec![0; 64 << 10];
    loop {
        let len = body.read(&mut bytes).map_err(refused)?;
        let read = bytes.get(..len).unwrap_or(&[]);
        if read.is_empty() {
            return Ok(());
        }
        match pipe.write_all(read) {
            Ok(()) => {}
            // Wireshark has stopped.
            Err(error) if is_broken_pipe(&error) => return Ok(()),
            Err(error) => return Err(format!("--fifo {}: {error}", fifo.display())),
        }
    }
}

/// Where the gateway's console listens.
fn console_of(ready: &Path) -> Result<String, String> {
    let name = ready.display();
    let text = fs::read_to_string(ready).map_err(|error| format!("--ready {name}: {error}"))?;
    let value: Value =
        serde_json::from_str(&text).map_err(|_| format!("--ready {name}: not a ready file"))?;
    let console = value.get("console").and_then(Value::as_str);
    let console = console
        .ok_or_else(|| format!("--ready {name}: the gateway has no console; start it with --console"))?;
    Ok(console.trim_start_matches("http://").trim_end_matches('/').to_owned())
}

/// A name in a query.
fn quoted(name: &str) -> String {
    let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-._~".contains(&byte);
    name.bytes()
        .map(|byte| if plain(byte) { char::from(byte).to_string() } else { format!("%{byte:02X}") })
        .collect()
}

/// The body of an answer of HTTP/1.1.
struct ChunkedBody<R> {
    from: R,
    /// Bytes that are left of a chunk; `None` if the body ends with the connection.
    chunk: Option<u64>,
    has_ended: bool,
}

impl<R: BufRead> ChunkedBody<R> {
    /// Reads the head; an answer other than 200 is an error.
    fn read_head(mut from: R) -> io::Result<Self> {
        let status = line(&mut from)?;
        let code = status.split(' ').nth(1).unwrap_or("");
        if !status.starts_with("HTTP/1.") || code != "200" {
            return Err(io::Error::other(format!("it answers {status:?}")));
        }
        let mut is_chunked = false;
        for _ in 0..MAX_HEADERS {
            let header = line(&mut from)?.to_ascii_lowercase();
            if header.is_empty() {
                return Ok(Self { from, chunk: is_chunked.then_some(0), has_ended: false });
            }
            is_chunked |= header.starts_with("transfer-encoding:") && header.ends_with("chunked");
        }
        Err(io::Error::other("it answers with too many headers"))
    }
}

impl<R: BufRead> Read for ChunkedBody<R> {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        if self.has_ended || bytes.is_empty() {
            return Ok(0);
        }
        let Some(left) = &mut self.chunk else { return self.from.read(bytes) };
        if *left == 0 {
            let size = line(&mut self.from)?;
            let size = size.split(';').next().unwrap_or("").trim();
            *left = u64::from_str_radix(size, 16).map_err(|_| io::Error::other("a chunk without a size"))?;
            if *left == 0 {
                self.has_ended = true;
                return Ok(0);
            }
        }
        let room = usize::try_from(*left).unwrap_or(usize::MAX).min(bytes.len());
        let len = self.from.read(bytes.get_mut(..room).unwrap_or(&mut []))?;
        if len == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        *left -= len as u64;
        if *left == 0 {
            line(&mut self.from)?;
        }
        Ok(len)
    }
}

/// A line without its end.
fn line(from: &mut impl BufRead) -> io::Result<String> {
    let mut bytes = Vec::new();
    from.by_ref().take(MAX_LINE).read_until(b'\n', &mut bytes)?;
    if bytes.pop() != Some(b'\n') {
        return Err(io::ErrorKind::UnexpectedEof.into());
    }
    if bytes.last() == Some(&b'\r') {
        bytes.pop();
    }
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}

const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);
const MAX_HEADERS: usize = 64;
const MAX_LINE: u64 = 8 << 10;

#[cfg(test)]
mod tests {
    use super::*;

    fn body(answer: &str) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        ChunkedBody::read_head(answer.as_bytes())?.read_to_end(&mut bytes)?;
        Ok(bytes)
    }

    #[test]
    fn answers_are_read_with_and_without_chunks() {
        assert_eq!(body("HTTP/1.1 200 OK\r\nX: y\r\n\r\nabc").unwrap(), b"abc");
        let chunked = "HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n3\r\nabc\r\nA;x=y\r\n0123456789\r\n0\r\n\r\n";
        assert_eq!(body(chunked).unwrap(), b"abc0123456789");
        for cut in ["", "HTTP/1.1 200 OK", "HTTP/1.1 200 OK\r\nX: y\r\n"] {
            assert!(body(cut).is_err(), "{cut:?}");
        }
        assert!(body(&chunked[..chunked.len() - 12]).is_err(), "a cut chunk");
        assert!(body("HTTP/1.1 404 Not Found\r\n\r\n").unwrap_err().to_string().contains("404"));
        assert!(body("SSH-2.0-x\r\n\r\n").is_err());
    }

    #[test]
    fn ports_may_have_any_name() {
        assert_eq!(quoted("rs485-1"), "rs485-1");
        assert_eq!(quoted("a&b=力"), "a%26b%3D%E5%8A%9B");
    }
}
