//! The table of endpoints: the operation of each method and path, which program serves it, and what it requires.

use crate::request::{HttpHead, Method, cut, trim};

/// The operation that a request asks for (docs/api.md).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum ApiOperation {
    /// The page for people.
    Page,
    /// What this server is.
    Info,
    /// State and counters.
    Status,
    /// The known variables.
    Values,
    /// State, counters and latencies as OpenMetrics.
    Metrics,
    /// The configuration: the running one, or another stored one.
    Config,
    /// The stored revisions, and which one runs.
    Revisions,
    /// Server-sent events.
    Stream,
    /// Frames as an endless capture (pcapng).
    Capture,
    /// The JSON Schema of configurations.
    Schema,
    /// The CAN database of the running configuration.
    ExportDbc,
    /// The Wireshark dissector of the running configuration.
    ExportLua,
    /// The table of variables of the running configuration.
    ExportMap,
    /// What is wrong, as text for people.
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
    /// Run a stored configuration on trial: unless it is confirmed, the one before returns.
    Apply,
    /// Make the configuration on trial the live one.
    Confirm,
    /// Return to the previous configuration.
    Rollback,
    /// Show which of several gateways this is.
    Identify,
    /// An operation of the simulated controller's pendant.
    Pendant,
    /// Set the key, after a press of the button.
    Claim,
    /// The firmware that runs, the one that is being received, and the trial.
    Update,
    /// Receive a piece of a firmware.
    PutUpdate,
    /// Run the received firmware on trial: unless it is confirmed, the one before returns.
    TryUpdate,
    /// Keep the firmware that is on trial.
    ConfirmUpdate,
    /// Return to the previous firmware.
    EndUpdate,
    /// State of the edge node.
    Edge,
    /// Store settings for the edge node.
    PutEdge,
}

impl ApiOperation {
    /// Whether its response goes on until the client disconnects.
    pub const fn is_endless(self) -> bool {
        matches!(self, Self::Stream | Self::Capture)
    }

    /// The arguments that may be in its query.
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

/// The programs that have endpoints.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Served {
    /// The gateway on a host.
    Gateway,
    /// The simulated controller.
    Controller,
    /// The gateway on a board.
    Board,
}

/// What a request needs before it is executed.
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
    /// No body.
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

    /// Whether `Content-Type` names this type; parameters such as a charset are ignored.
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
    /// The method; [`Method::Get`] also stands for `HEAD`, except for endless responses.
    pub method: Method,
    /// The operation.
    pub operation: ApiOperation,
    /// What the request needs.
    pub access: Access,
    /// The type of the body.
    pub body: BodyType,
    /// Which programs serve it.
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
    // The board has no key yet that a client could show; the press of the button takes its place.
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

/// Why no route was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RouteError {
    /// There is no such path.
    NotFound,
    /// The path exists, but not with this method; this is the value of `Allow`.
    Method(&'static str),
}

/// Finds the route of a request.
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
    /// Whether the endpoint takes this method.
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
            // A board has no key yet when it is claimed.
            let reads = reads || route.operation == ApiOperation::Claim;
            assert_eq!(route.access == Access::Write, !reads, "{}", route.path);
            assert_eq!(route.body == BodyType::None, route.method == Method::Get, "{}", route.path);
        }
    }
}
