//! The table of endpoints: which method and path is which operation, who serves it, and what it asks for.

use crate::request::{HttpHead, Method, cut, trim};

/// What a request asks for (docs/api.md).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum ApiOperation {
    /// The page for people.
    Page,
    /// Who and what this is.
    Info,
    /// State and counters.
    Status,
    /// The known variables.
    Values,
    /// State, counters and latencies as OpenMetrics.
    Metrics,
    /// The configuration: the running one, or another that is kept.
    Config,
    /// The revisions that are kept, and which is running.
    Revisions,
    /// Server-sent events.
    Stream,
    /// Frames as a capture (pcapng) that goes on.
    Capture,
    /// The JSON Schema of configurations.
    Schema,
    /// The CAN database of what runs.
    ExportDbc,
    /// The dissector for Wireshark of what runs.
    ExportLua,
    /// The table of variables of what runs.
    ExportMap,
    /// What is wrong, in words.
    Doctor,
    /// The newest lines of the log.
    Log,
    /// Everything that can be read, in one document.
    Bundle,
    /// A nonce for one signed request.
    Nonce,
    /// Check a configuration without storing it.
    Check,
    /// Store a configuration.
    PutConfig,
    /// Run a stored configuration, and return to the one before unless it is confirmed.
    Apply,
    /// Keep what is running.
    Confirm,
    /// Return to the configuration before.
    Rollback,
    /// Show which one this is, among several.
    Identify,
    /// An operation of the simulated controller's pendant.
    Pendant,
    /// Take this key, after a press of the button.
    Claim,
    /// The firmware that runs, the one that is being received, and a trial.
    Update,
    /// Take a piece of a firmware.
    PutUpdate,
    /// Run the firmware that was received, and return to the one before unless it is confirmed.
    TryUpdate,
    /// Keep the firmware that is on trial.
    ConfirmUpdate,
    /// Return to the firmware before.
    EndUpdate,
    /// How the edge node does.
    Edge,
    /// Keep settings for the edge node.
    PutEdge,
}

impl ApiOperation {
    /// Whether its answer goes on until the client leaves.
    pub const fn is_endless(self) -> bool {
        matches!(self, Self::Stream | Self::Capture)
    }

    /// The arguments that its query may have.
    pub const fn arguments(self) -> &'static [&'static str] {
        match self {
            Self::Config => &["revision"],
            Self::Stream => &["frames", "port"],
            Self::Capture | Self::ExportDbc => &["port"],
            Self::Log => &["lines"],
            Self::Check => &["image"],
            Self::PutUpdate => &["offset", "downgrade"],
            Self::TryUpdate => &["downgrade"],
            Self::PutEdge => &["restart"],
            _ => &[],
        }
    }
}

/// What a program serves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Served {
    /// The gateway on a host.
    Gateway,
    /// The simulated controller.
    Controller,
    /// The gateway on a board.
    Board,
}

/// What a request needs before it is carried out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    /// Nothing.
    Open,
    /// The key, unless client and server are on one machine.
    Read,
    /// The key.
    Write,
}

/// The type of a body.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BodyType {
    /// There is none.
    None,
    /// `application/toml`.
    Toml,
    /// `application/json`; a request without a body needs no type.
    Json,
    /// `application/octet-stream`: a configuration image, a piece of a firmware, or settings of an edge node.
    Image,
}

impl BodyType {
    /// The media type; empty if there is no body.
    pub const fn name(self) -> &'static str {
        match self {
            Self::None => "",
            Self::Toml => "application/toml",
            Self::Json => "application/json",
            Self::Image => "application/octet-stream",
        }
    }

    /// Whether `Content-Type` names it; parameters such as a charset are not looked at.
    pub fn is(self, content_type: &str) -> bool {
        let name = cut(content_type, b';').map_or(content_type, |(name, _)| name);
        trim(name).eq_ignore_ascii_case(self.name())
    }
}

/// One endpoint with one method.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct Route {
    /// The path.
    pub path: &'static str,
    /// The method; [`Method::Get`] stands for `HEAD` too, but for answers that go on.
    pub method: Method,
    /// What is done.
    pub operation: ApiOperation,
    /// What it needs.
    pub access: Access,
    /// What its body is.
    pub body: BodyType,
    /// Who serves it.
    pub served: &'static [Served],
}

/// All endpoints.
pub const ROUTES: &[Route] = &[
    Route { access: Access::Open, ..get("/", ApiOperation::Page, ALL) },
    get("/api/v1/info", ApiOperation::Info, ALL),
    get("/api/v1/status", ApiOperation::Status, ALL),
    get("/api/v1/values", ApiOperation::Values, GATEWAYS),
    get("/api/v1/metrics", ApiOperation::Metrics, GATEWAYS),
    get("/api/v1/config", ApiOperation::Config, GATEWAYS),
    put("/api/v1/config", ApiOperation::PutConfig, BodyType::Toml, GATEWAY),
    put("/api/v1/config", ApiOperation::PutConfig, BodyType::Image, BOARD),
    get("/api/v1/revisions", ApiOperation::Revisions, GATEWAYS),
    get("/api/v1/stream", ApiOperation::Stream, ALL),
    get("/api/v1/capture.pcapng", ApiOperation::Capture, GATEWAY),
    get("/api/v1/schema", ApiOperation::Schema, GATEWAY),
    get("/api/v1/export/dbc", ApiOperation::ExportDbc, GATEWAY),
    get("/api/v1/export/lua", ApiOperation::ExportLua, GATEWAY),
    get("/api/v1/export/md", ApiOperation::ExportMap, GATEWAY),
    get("/api/v1/doctor", ApiOperation::Doctor, GATEWAY),
    get("/api/v1/log", ApiOperation::Log, ALL),
    get("/api/v1/bundle", ApiOperation::Bundle, HOSTS),
    Route { access: Access::Open, ..get("/api/v1/nonce", ApiOperation::Nonce, ALL) },
    Route { access: Access::Read, body: BodyType::Toml, ..post("/api/v1/check", ApiOperation::Check, HOSTS) },
    post("/api/v1/apply", ApiOperation::Apply, GATEWAYS),
    post("/api/v1/confirm", ApiOperation::Confirm, GATEWAYS),
    post("/api/v1/rollback", ApiOperation::Rollback, GATEWAYS),
    post("/api/v1/identify", ApiOperation::Identify, GATEWAYS),
    post("/api/v1/pendant", ApiOperation::Pendant, CONTROLLER),
    get("/api/v1/update", ApiOperation::Update, GATEWAYS),
    put("/api/v1/update", ApiOperation::PutUpdate, BodyType::Image, GATEWAYS),
    post("/api/v1/update/try", ApiOperation::TryUpdate, GATEWAYS),
    post("/api/v1/update/confirm", ApiOperation::ConfirmUpdate, GATEWAYS),
    post("/api/v1/update/back", ApiOperation::EndUpdate, GATEWAYS),
    get("/api/v1/edge", ApiOperation::Edge, GATEWAYS),
    put("/api/v1/edge", ApiOperation::PutEdge, BodyType::Image, GATEWAYS),
    // There is no key to be shown yet; the button stands for it.
    Route { access: Access::Open, ..post("/api/v1/claim", ApiOperation::Claim, BOARD) },
];

const ALL: &[Served] = &[Served::Gateway, Served::Controller, Served::Board];
const HOSTS: &[Served] = &[Served::Gateway, Served::Controller];
const GATEWAYS: &[Served] = &[Served::Gateway, Served::Board];
const GATEWAY: &[Served] = &[Served::Gateway];
const CONTROLLER: &[Served] = &[Served::Controller];
const BOARD: &[Served] = &[Served::Board];

/// A read without a body.
const fn get(path: &'static str, operation: ApiOperation, served: &'static [Served]) -> Route {
    Route { path, method: Method::Get, operation, access: Access::Read, body: BodyType::None, served }
}

/// A change with arguments.
const fn post(path: &'static str, operation: ApiOperation, served: &'static [Served]) -> Route {
    Route { path, method: Method::Post, operation, access: Access::Write, body: BodyType::Json, served }
}

const fn put(
    path: &'static str,
    operation: ApiOperation,
    body: BodyType,
    served: &'static [Served],
) -> Route {
    Route { path, method: Method::Put, operation, access: Access::Write, body, served }
}

/// Why there is no route.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RouteError {
    /// There is no such path.
    NotFound,
    /// The path has other methods; this is the value of `Allow`.
    Method(&'static str),
}

/// The route of a request.
pub fn find(head: &HttpHead<'_>, served: Served) -> Result<&'static Route, RouteError> {
    let path = head.path();
    let here = || ROUTES.iter().filter(move |route| route.path == path && route.served.contains(&served));
    if let Some(route) = here().find(|route| route.takes(head.method)) {
        return Ok(route);
    }
    let (mut gets, mut changes) = (None, None);
    for route in here() {
        match route.method {
            Method::Get => gets = Some(route.operation.is_endless()),
            other => changes = Some(other),
        }
    }
    Err(match (gets, changes) {
        (None, None) => RouteError::NotFound,
        (Some(true), _) => RouteError::Method("GET"),
        (Some(false), Some(_)) => RouteError::Method("GET, HEAD, PUT"),
        (Some(false), None) => RouteError::Method("GET, HEAD"),
        (None, Some(_)) => RouteError::Method("POST"),
    })
}

impl Route {
    /// Whether a request with this method is for it.
    pub fn takes(&self, method: Method) -> bool {
        self.method == method
            || method == Method::Head && self.method == Method::Get && !self.operation.is_endless()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::request::HeadBuffer;
    use std::format;
    use std::string::String;
    use std::vec::Vec;

    fn found(method: &str, path: &str, served: Served) -> Result<ApiOperation, RouteError> {
        let mut buffer = HeadBuffer::new();
        buffer.push(format!("{method} {path} HTTP/1.1\r\nHost: a\r\n\r\n").as_bytes());
        find(&buffer.head().unwrap(), served).map(|route| route.operation)
    }

    #[test]
    fn every_route_is_found_and_its_other_methods_name_it() {
        for &served in ALL {
            for route in ROUTES.iter().filter(|route| route.served.contains(&served)) {
                assert_eq!(found(route.method.name(), route.path, served), Ok(route.operation));
                assert_eq!(
                    found(route.method.name(), &format!("{}?x=1", route.path), served),
                    Ok(route.operation)
                );
                let all: Vec<_> = ["GET", "HEAD", "POST", "PUT"]
                    .into_iter()
                    .filter(|method| found(method, route.path, served).is_ok())
                    .collect();
                for other in ["GET", "HEAD", "POST", "PUT", "OPTIONS", "DELETE", "PATCH", "TRACE", "get"] {
                    if !all.contains(&other) {
                        let allowed: String = all.join(", ");
                        match found(other, route.path, served) {
                            Err(RouteError::Method(allow)) => assert_eq!(allow, allowed, "{}", route.path),
                            wrong => panic!("{other} {}: {wrong:?}", route.path),
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn other_paths_and_those_of_the_other_program_are_not_there() {
        for path in
            ["/api", "/api/v1/", "/api/v1/info/", "/API/v1/info", "/api/v1/%69nfo", "//", "/api/v1/pendant"]
        {
            assert_eq!(found("GET", path, Served::Gateway), Err(RouteError::NotFound), "{path}");
        }
        assert_eq!(found("PUT", "/api/v1/config", Served::Controller), Err(RouteError::NotFound));
        assert_eq!(found("POST", "/api/v1/check", Served::Board), Err(RouteError::NotFound));
        assert_eq!(found("POST", "/api/v1/claim", Served::Gateway), Err(RouteError::NotFound));
    }

    #[test]
    fn whatever_changes_something_is_no_get_and_needs_the_key() {
        for route in ROUTES {
            let reads = route.method == Method::Get || route.operation == ApiOperation::Check;
            // Without a key there is none to be shown.
            let reads = reads || route.operation == ApiOperation::Claim;
            assert_eq!(route.access == Access::Write, !reads, "{}", route.path);
            assert_eq!(route.body == BodyType::None, route.method == Method::Get, "{}", route.path);
        }
    }
}
