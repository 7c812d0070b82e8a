//! A plugged-in adapter, and programs on its interface.

use std::path::Path;

use serde_json::Value;

use super::BINARY;
use super::candlelight::{Bus, CandleLight, Restart};
use super::usb::Plugged;
use recipe_test_kit::can::tool;
use recipe_test_kit::{HostSim, example, until};

/// The kernel's name of the first adapter's interface.
pub(crate) const INTERFACE: &str = "can0";

/// An adapter that is plugged in.
pub(crate) struct Adapter(Plugged<CandleLight>);

impl Adapter {
    /// Plugs it in; its interface exists and is down.
    #[track_caller]
    pub(crate) fn new() -> Self {
        // A USB port is free before the previous interface is gone.
        until("no adapter is left", || (!is_there()).then_some(()));
        let adapter = Self(Plugged::new(CandleLight::new()));
        until("the adapter's interface", || is_there().then_some(()));
        adapter
    }

    /// Plugs it in and brings the interface up.
    #[track_caller]
    pub(crate) fn up(bitrate: u32) -> Self {
        let adapter = Self::new();
        adapter.bring_up(bitrate);
        adapter
    }

    #[track_caller]
    pub(crate) fn bring_up(&self, bitrate: u32) {
        tool(&format!("ip link set {INTERFACE} type can bitrate {bitrate}"));
        tool(&format!("ip link set {INTERFACE} up"));
        assert_eq!(self.0.with(|adapter| (adapter.is_on(), adapter.bitrate())), (true, Some(bitrate)));
    }

    /// Unplugs it.
    #[track_caller]
    pub(crate) fn unplug(self) {
        drop(self);
        until("the interface is gone", || (!is_there()).then_some(()));
    }

    pub(crate) fn becomes(&self, bus: Bus) {
        self.0.with(|adapter| adapter.becomes(bus));
    }

    pub(crate) fn receive_from_bus(&self, frame: &str) {
        self.0.with(|adapter| adapter.receive_from_bus(frame));
    }

    /// Number of other nodes' frames that were passed to the driver so far.
    pub(crate) fn heard(&self) -> u64 {
        self.0.with(|adapter| adapter.heard())
    }

    /// Another node sends a frame repeatedly, as devices do, until the controller's register has this value. A
    /// gateway that was stalled for half a second discards waiting frames.
    #[track_caller]
    pub(crate) fn hears_until(&self, frame: &str, robot: &HostSim, register: &str, value: f64) {
        until(&format!("{register} = {value}"), || {
            self.receive_from_bus(frame);
            let found = robot.fresh()["registers"][register].as_f64().unwrap_or(0.0);
            (found == value).then_some(())
        });
    }

    pub(crate) fn hears_after_a_loss(&self, frame: &str) {
        self.0.with(|adapter| adapter.hears_after_a_loss(frame));
    }

    pub(crate) fn hears_noise(&self, frames: u16) {
        self.0.with(|adapter| adapter.hears_noise(frames));
    }

    pub(crate) fn restarts(&self, how: Restart) {
        self.0.with(|adapter| adapter.restarts(how));
    }

    /// Number of frames that the driver has sent so far, whether they were on the bus or not.
    pub(crate) fn given(&self) -> usize {
        self.0.with(|adapter| adapter.given())
    }

    /// Forgets the frames that were on the bus.
    pub(crate) fn forget(&self) {
        self.0.with(CandleLight::sent);
    }

    /// Waits for this many frames on the bus, from now on.
    #[track_caller]
    pub(crate) fn sends(&self, count: usize) -> Vec<String> {
        let mut sent = Vec::new();
        until(&format!("{count} frames on the bus"), || {
            sent.extend(self.0.with(CandleLight::sent));
            (sent.len() >= count).then_some(())
        });
        sent
    }

    /// Waits for a frame on the bus; drops those up to it.
    #[track_caller]
    pub(crate) fn sends_a(&self, frame: &str) {
        until(frame, || self.0.with(CandleLight::sent).iter().any(|sent| sent == frame).then_some(()));
    }
}

fn is_there() -> bool {
    std::fs::exists(format!("/sys/class/net/{INTERFACE}")).unwrap()
}

/// A gateway with this file on the interface, and its controller.
pub(crate) struct Cell {
    pub(crate) robot: HostSim,
    pub(crate) gateway: HostSim,
    port: &'static str,
}

impl Cell {
    /// The hand's gateway: one frame each 20 ms, which follows the controller's word registers.
    #[track_caller]
    pub(crate) fn hand() -> Self {
        let robot = BINARY.controller(&example("can-hand-controller.toml"), &[]);
        let gateway = BINARY.gateway(&example("can-hand.toml"), &robot, &[&bind("hand")]);
        Self { robot, gateway, port: "hand" }
    }

    /// The worked example's gateway, with three frames each 20 ms, since an emulated processor is slow.
    #[track_caller]
    pub(crate) fn system() -> Self {
        let elsewhere = "--bind=can=slcan-tcp:127.0.0.1:0";
        let robot = BINARY.controller(&example("can-system-controller.toml"), &[elsewhere]);
        let gateway = BINARY.gateway(&example("can-system.toml"), &robot, &[&bind("can-1"), SLOWLY]);
        Self { robot, gateway, port: "can-1" }
    }

    /// A gateway with this file, whose port is `can`, and the hand's controller.
    #[track_caller]
    pub(crate) fn of(file: &Path) -> Self {
        let robot = BINARY.controller(&example("can-hand-controller.toml"), &[]);
        let gateway = BINARY.gateway(file, &robot, &[&bind("can")]);
        Self { robot, gateway, port: "can" }
    }

    /// The gateway's statistics of its port, once they satisfy `found`.
    #[track_caller]
    pub(crate) fn port(&self, what: &str, found: impl Fn(&Value) -> bool) -> Value {
        self.gateway.stats(what, |stats| found(&stats["ports"][self.port]))["ports"][self.port].clone()
    }

    /// Statistics of its port that were collected after this call.
    #[track_caller]
    pub(crate) fn fresh(&self) -> Value {
        self.gateway.fresh()["ports"][self.port].clone()
    }

    /// Statistics of its port, once the bus is in this state.
    #[track_caller]
    pub(crate) fn bus(&self, state: &str) -> Value {
        self.port(state, |port| port["device"]["bus"] == state)
    }

    /// Waits until the bus is active and this many restarts were reported. The gateway may see the interface's
    /// state before it reads the frame that reports the restart.
    #[track_caller]
    pub(crate) fn restarted(&self, times: u64) {
        self.port("restarted", |port| {
            port["device"]["bus"] == "active" && port["device"]["restarts"].as_u64() == Some(times)
        });
    }

    /// The hand sends its grip until the controller has it.
    #[track_caller]
    pub(crate) fn grips(&self, adapter: &Adapter, grip: u16) {
        let [low, high] = grip.to_le_bytes();
        let frame = format!("502#0307{low:02X}{high:02X}");
        adapter.hears_until(&frame, &self.robot, "WordInputReg[3]", f64::from(grip));
    }

    /// Waits until the controller has this in its register.
    #[track_caller]
    pub(crate) fn register(&self, name: &str, value: f64) {
        self.robot.stats(&format!("{name} = {value}"), |stats| {
            stats["registers"][name].as_f64().unwrap_or(0.0) == value
        });
    }

    /// Waits for half a second of the gateway's time, in which it checks a bus that is off three times.
    #[track_caller]
    pub(crate) fn looks_on(&self, look: impl Fn(&Value)) {
        // Statistics come each 50 ms, and each call takes two lines.
        for _ in 0..5 {
            look(&self.fresh());
        }
    }

    #[track_caller]
    pub(crate) fn end(self) {
        self.gateway.end();
        self.robot.end();
    }
}

const SLOWLY: &str = "--set=port.can-1.cycle_ms=20";

pub(crate) fn bind(port: &str) -> String {
    format!("--bind={port}=socketcan:{INTERFACE}")
}
