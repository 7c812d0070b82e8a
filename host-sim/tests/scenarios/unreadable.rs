//! A state stream with a value that is not finite: it is not shown, and no other value in its place.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::{Duration, Instant};

use recipe_test_kit::until;

use super::case::{Case, Scenario};
use super::environment::Link;
use super::examples::{ROBOT, pose_frame};
use super::network::{Filter, Network, Pass};

pub(crate) fn all() -> Vec<Scenario> {
    vec![
        Scenario::new("a_pose_that_is_no_number_is_not_shown", |case| pose(case, "stop")),
        Scenario::new("a_pose_that_is_no_number_is_not_held", |case| pose(case, "hold")),
    ]
}

/// Length of a packet of the state stream, and place of `RobotState[8]` in it.
const PACKET: usize = 1_468;
const X: std::ops::Range<usize> = 368..372;
/// Longer than the time after which a value is stale.
const WATCHED: Duration = Duration::from_secs(1);

/// How often the pose is sent. On a busy machine the kernel has been seen to pass on nothing of a pseudoterminal for six
/// seconds, and the terminal loses what does not fit its 16 KiB: at 1 kB/s that is enough for 16 s.
const CYCLE_MS: u32 = 20;
/// All is heard when as many frames as were sent have come for so long: the counters may be late as well.
const SETTLED: Duration = Duration::from_millis(500);
/// Longest wait for that.
const LATEST: Duration = Duration::from_secs(40);

/// Overwrites a value in the packets of a connection.
#[derive(Debug, Default)]
struct Spoiler {
    is_on: AtomicBool,
    /// Number of packets changed so far.
    spoiled: AtomicU32,
}

impl Spoiler {
    /// The filter for a connection. A packet that has begun is not changed.
    fn filter(self: Arc<Self>) -> Box<Filter> {
        let (mut at, mut spoils) = (0, false);
        Box::new(move |bytes| {
            for byte in bytes {
                if at == 0 {
                    spoils = self.is_on.load(Ordering::SeqCst);
                }
                if spoils && X.contains(&at) {
                    *byte = f32::NAN.to_le_bytes()[at - X.start];
                }
                at = (at + 1) % PACKET;
                if at == 0 && spoils {
                    self.spoiled.fetch_add(1, Ordering::SeqCst);
                }
            }
            Pass::On
        })
    }

    /// Waits until this many more have passed: all but the newest one have certainly been received.
    #[track_caller]
    fn until_spoiled(&self, more: u32) {
        let wanted = self.spoiled.load(Ordering::SeqCst) + more;
        until("spoilt packets", || (self.spoiled.load(Ordering::SeqCst) >= wanted).then_some(()));
    }
}

/// The same for both settings of `on_stale`.
fn pose(case: &Case, on_stale: &str) {
    let robot = case.robot(ROBOT).start();
    let spoiler = Arc::new(Spoiler::default());
    spoiler.is_on.store(true, Ordering::SeqCst);
    let mut way = Network::default();
    let state = way.tcp_through(robot.address("state"), {
        let spoiler = Arc::clone(&spoiler);
        move |_| [Box::new(|_: &mut Vec<u8>| Pass::On), Arc::clone(&spoiler).filter()]
    });
    let plan = case.gateway("rs485-system.toml").robot(&robot).server_at("state", state);
    let plan = plan.set("port.rs485-1.cycle_ms", CYCLE_MS);
    let mut gateway = plan.set("recipe.system.output.on_stale", on_stale).start();
    let mut device = gateway.line("rs485-1");
    gateway.until_up(Link::State, 1);
    spoiler.until_spoiled(2);
    device.is_silent(WATCHED);
    let pose = pose_frame(4);
    let mut heard = 0;
    for _ in 0..2 {
        spoiler.is_on.store(false, Ordering::SeqCst);
        for nth in 0..20 {
            assert_eq!(device.take(pose.len()), pose, "frame {nth}");
        }
        spoiler.is_on.store(true, Ordering::SeqCst);
        spoiler.until_spoiled(3);
        // A busy machine brings what was sent before later.
        let mut frames = Vec::new();
        let (begin, mut settled) = (Instant::now(), Instant::now());
        let mut all = 0;
        while settled.elapsed() < SETTLED {
            gateway.must_run();
            frames.append(&mut device.take_all());
            let status = gateway.port("rs485-1");
            let now = heard + 20 + (frames.len() / pose.len()) as u64;
            if now != status.frames_out || now != all {
                (all, settled) = (now, Instant::now());
            }
            assert_eq!(status.lost_bytes, 0, "the machine did not move the terminal's bytes: {status:?}");
            assert!(begin.elapsed() < LATEST, "{all} frames were heard of {status:?}");
            std::thread::sleep(Duration::from_millis(5));
        }
        heard = all;
        // The device received complete frames, and only with the readable pose.
        let mut frames = frames.chunks(pose.len());
        assert!(frames.all(|frame| frame == pose), "something else than the pose was sent");
        device.is_silent(WATCHED);
    }
    assert_eq!(gateway.link(Link::State).connects, 1, "the link was given up for a value");
}
