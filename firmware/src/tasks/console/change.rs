//! Operations that change something.

use core::fmt::Write;

use embassy_futures::yield_now;
use embassy_time::{Duration, Instant};
use proto_core::config::image;
use recipe_api::claim::{Claim, ClaimError};
use recipe_api::key::{KEY_LEN, Key};
use recipe_api::response::{ContentType, StatusCode};
use recipe_api::revisions::{Refused, base_of};
use recipe_api::route::ApiOperation;
use recipe_update::Downgrade;

use super::answer::{Reply, busy, nothing_kept};
use super::arguments::{Arguments, ConsoleRequest};
use super::{Console, edge};
use crate::clock::now;
use crate::fmt::DisplayText;
use crate::tasks::store::{Failed, StoreLock, StoreRequest};
use crate::warn;

impl Console {
    pub(super) async fn change<'a>(&'a self, buf: &mut [u8], request: ConsoleRequest<'a>) -> Reply {
        let ConsoleRequest { operation, peer, .. } = request;
        if operation == ApiOperation::PutConfig
            && let Some((len, lock)) = &request.image
            && let Some(refused) = self.look_through(buf, *len, lock).await
        {
            return refused;
        }
        let (change, lock) = match self.prepare(buf, request) {
            Ok(prepared) => prepared,
            Err(reply) => return reply,
        };
        let done = lock.request(change.clone()).await;
        match (done, change) {
            (Ok(_), StoreRequest::Claim(key)) => {
                self.is_claimed(Some(key));
                warn!("claimed by {}", DisplayText(&peer));
                let name = &self.name;
                Reply::new(buf, StatusCode::OK, ContentType::Json, |out| {
                    write!(out, "{{\"name\":\"{name}\",\"claimed\":true}}")
                })
            }
            (Err(_), StoreRequest::Claim(_)) => {
                self.is_claimed(None);
                Reply::error(buf, StatusCode::INTERNAL, "the key cannot be kept")
            }
            // Pieces are not logged, because an update has many.
            (Ok(_), StoreRequest::Piece { .. }) => self.firmware(buf, StatusCode::OK),
            (Ok(_), StoreRequest::ConfirmFirmware) => {
                warn!("the firmware is confirmed for {}", DisplayText(&peer));
                self.firmware(buf, StatusCode::OK)
            }
            (Ok(_), StoreRequest::TryFirmware { .. } | StoreRequest::EndFirmware) => {
                warn!("another firmware is to run for {}", DisplayText(&peer));
                self.firmware(buf, StatusCode::ACCEPTED)
            }
            (Ok(_), StoreRequest::Edge { publishes, restart, .. }) => {
                self.edge_stored(buf, peer, publishes, restart)
            }
            (Err(Failed::Firmware(why)), _) => {
                warn!("{} refused to {}: {}", name(operation), DisplayText(&peer), DisplayText(&why));
                let status = if why.is_wrong() { StatusCode::UNPROCESSABLE } else { StatusCode::CONFLICT };
                Reply::error(buf, status, why)
            }
            (Ok(number), _) => {
                warn!("{} for {}: revision {}", name(operation), DisplayText(&peer), number);
                let status =
                    if operation == ApiOperation::PutConfig { StatusCode::CREATED } else { StatusCode::OK };
                self.revisions(buf, status, Some(number))
            }
            (Err(Failed::Refused(refused)), _) => {
                warn!("{} refused to {}", name(operation), DisplayText(&peer));
                refuse(buf, refused)
            }
            (Err(Failed::Store(why)), _) => Reply::error(buf, StatusCode::INTERNAL, why),
        }
    }

    /// Validates the image that was sent, in steps between which other tasks run. Returns the reply if it is invalid.
    async fn look_through(&self, buf: &mut [u8], len: usize, lock: &StoreLock<'_>) -> Option<Reply> {
        lock.begin_scan();
        loop {
            match lock.scan(len) {
                Ok(true) => yield_now().await,
                Ok(false) => break,
                Err(error) => return Some(Reply::error(buf, StatusCode::UNPROCESSABLE, error)),
            }
        }
        let missing = lock.buses(|buses| self.ports.have(buses.iter())).err()?;
        Some(Reply::error(buf, StatusCode::UNPROCESSABLE, missing))
    }

    /// The request for the store task, or the reply if there is none.
    #[inline(never)]
    fn prepare<'a>(
        &'a self,
        buf: &mut [u8],
        request: ConsoleRequest<'a>,
    ) -> Result<(StoreRequest, StoreLock<'a>), Reply> {
        let change = match request.arguments {
            Arguments::Wrong(text) => return Err(Reply::error(buf, StatusCode::BAD_REQUEST, text)),
            Arguments::Seconds(seconds) => {
                self.identify_until.set(Instant::now() + Duration::from_secs(seconds.into()));
                warn!(
                    "{} looks for this board: its LED shows it for {} s",
                    DisplayText(&request.peer),
                    seconds
                );
                return Err(Reply::new(buf, StatusCode::OK, ContentType::Json, |out| out.write_str("{}")));
            }
            Arguments::Key(key) => return self.take_key(buf, key, &request),
            Arguments::Apply { number, trial } => StoreRequest::Apply { number, trial },
            Arguments::None if request.operation == ApiOperation::Confirm => StoreRequest::Confirm,
            Arguments::None if request.operation == ApiOperation::Rollback => StoreRequest::RollBack,
            Arguments::None if request.operation == ApiOperation::ConfirmUpdate => {
                StoreRequest::ConfirmFirmware
            }
            Arguments::None if request.operation == ApiOperation::EndUpdate => StoreRequest::EndFirmware,
            Arguments::Try(confirm_s) => {
                StoreRequest::TryFirmware { confirm_s, downgrade: downgrade(buf, &request)? }
            }
            Arguments::None if request.operation == ApiOperation::PutUpdate => {
                return put_piece(buf, request);
            }
            Arguments::None if request.operation == ApiOperation::PutEdge => {
                return edge::settings(buf, request);
            }
            Arguments::None => return put(buf, request),
        };
        let Some(store) = self.store else { return Err(nothing_kept(buf)) };
        store.take().map(|lock| (change, lock)).ok_or_else(|| busy(buf))
    }

    /// Accepts a key if the button was pressed.
    fn take_key(
        &self,
        buf: &mut [u8],
        key: [u8; KEY_LEN],
        request: &ConsoleRequest<'_>,
    ) -> Result<(StoreRequest, StoreLock<'_>), Reply> {
        let Some(store) = self.store else { return Err(nothing_kept(buf)) };
        // Take the lock before the claim begins, because a claim that has begun must be finished. No key is accepted
        // while the store is being read.
        let Some(lock) = store.take().filter(|_| store.look(|_| ()).is_some()) else {
            return Err(busy(buf));
        };
        let mut claim = self.claim.get();
        let offered = claim.offered(now());
        self.claim.set(claim);
        let (status, text) = match offered {
            Ok(()) => return Ok((StoreRequest::Claim(key), lock)),
            Err(ClaimError::NotPressed) => {
                (StatusCode::FORBIDDEN, "press the button of the board first; a key is taken for 60 s then")
            }
            Err(ClaimError::Busy) => (StatusCode::CONFLICT, "another key is being taken; try again"),
            Err(ClaimError::Claimed) => (StatusCode::FORBIDDEN, "this board has a key already"),
        };
        warn!("claim refused to {}", DisplayText(&request.peer));
        Err(Reply::error(buf, status, text))
    }

    /// Ends a claim: the key was stored, or could not be.
    fn is_claimed(&self, key: Option<[u8; KEY_LEN]>) {
        let mut claim: Claim = self.claim.get();
        claim.written(now(), key.is_some());
        self.claim.set(claim);
        if let Some(key) = key {
            self.guard.borrow_mut().set_key(Some(Key::new(key)));
        }
    }
}

fn downgrade(buf: &mut [u8], request: &ConsoleRequest<'_>) -> Result<Downgrade, Reply> {
    match request.head.yes {
        None => Ok(Downgrade::Refused),
        Some(true) => Ok(Downgrade::Allowed),
        Some(false) => {
            Err(Reply::error(buf, StatusCode::BAD_REQUEST, "downgrade is out of range; allowed: yes"))
        }
    }
}

fn put_piece<'a>(
    buf: &mut [u8],
    request: ConsoleRequest<'a>,
) -> Result<(StoreRequest, StoreLock<'a>), Reply> {
    let downgrade = downgrade(buf, &request)?;
    let Some((len, lock)) = request.image else { return Err(busy(buf)) };
    let Some(Some(offset)) = request.head.number else {
        let text = "offset must be a number: where the piece begins in header and image";
        return Err(Reply::error(buf, StatusCode::BAD_REQUEST, text));
    };
    Ok((StoreRequest::Piece { offset, len, downgrade }, lock))
}

fn put<'a>(buf: &mut [u8], request: ConsoleRequest<'a>) -> Result<(StoreRequest, StoreLock<'a>), Reply> {
    let Some((len, lock)) = request.image else { return Err(busy(buf)) };
    let base = base_of(request.head.if_match).map_err(|refusal| Reply::refused(buf, &refusal))?;
    // Trailing bytes would waste flash.
    let whole = lock.look(len, |bytes| Ok((image::intact(bytes)?, image::image_len(bytes)?)));
    match whole {
        Ok((digest, len)) => Ok((StoreRequest::Put { base, digest, len }, lock)),
        Err(error) => {
            let error: image::ImageError = error;
            Err(Reply::error(buf, StatusCode::UNPROCESSABLE, error))
        }
    }
}

fn refuse(buf: &mut [u8], refused: Refused) -> Reply {
    let base = match refused {
        Refused::Changed(base) => Some(base),
        _ => None,
    };
    Reply::error(buf, refused.status(), refused).about(base)
}

/// Name of the operation in the log.
fn name(operation: ApiOperation) -> &'static str {
    match operation {
        ApiOperation::PutConfig => "store",
        ApiOperation::Apply => "apply",
        ApiOperation::Confirm => "confirm",
        ApiOperation::PutUpdate => "a piece of a firmware",
        ApiOperation::TryUpdate => "a trial of a firmware",
        ApiOperation::ConfirmUpdate => "the end of a firmware's trial",
        ApiOperation::EndUpdate => "a return to the firmware before",
        ApiOperation::PutEdge => "settings of the edge node",
        _ => "roll back",
    }
}
