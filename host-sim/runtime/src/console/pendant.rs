//! The pendant of the simulated controller: operations of docs/control.md, passed on to its control socket.

use std::io;
use std::net::SocketAddr;
use std::time::Duration;

use recipe_api::response::{ContentType, StatusCode};
use serde_json::{Map, Value};
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::TcpStream;
use tokio::time::timeout;

use super::reply::HttpReply;

pub(super) async fn operate(control: SocketAddr, body: &[u8]) -> HttpReply {
    let request = match serde_json::from_slice::<Map<String, Value>>(body) {
        Ok(request) => request,
        Err(error) => {
            return HttpReply::error(StatusCode::BAD_REQUEST, &format!("not a JSON object: {error}"));
        }
    };
    if request.get("do").is_some_and(|what| what == "follow") {
        let text = "events are followed at the control socket; see GET /api/v1/stream for the state";
        return HttpReply::error(StatusCode::BAD_REQUEST, text);
    }
    let line = Value::Object(request).to_string() + "\n";
    match timeout(MAX_TIME, ask(control, &line)).await {
        Ok(Ok(answer)) => {
            let is_done = serde_json::from_str::<Value>(&answer).is_ok_and(|answer| answer["ok"] == true);
            let status = if is_done { StatusCode::OK } else { StatusCode::UNPROCESSABLE };
            HttpReply::new(status, ContentType::Json, answer.trim_end())
        }
        Ok(Err(error)) => HttpReply::error(StatusCode::UNAVAILABLE, &format!("control socket: {error}")),
        Err(_) => HttpReply::error(
            StatusCode::UNAVAILABLE,
            "the operation takes longer than 30 s; use the control socket",
        ),
    }
}

async fn ask(control: SocketAddr, line: &str) -> io::Result<String> {
    let mut stream = TcpStream::connect(control).await?;
    stream.write_all(line.as_bytes()).await?;
    let mut answer = String::new();
    BufReader::new(stream.take(MAX_ANSWER)).read_line(&mut answer).await?;
    match answer.ends_with('\n') {
        true => Ok(answer),
        false => Err(io::ErrorKind::UnexpectedEof.into()),
    }
}

const MAX_TIME: Duration = Duration::from_secs(30);
const MAX_ANSWER: u64 = 4 << 20;
