//! An Ethernet controller with limited reads.
//!
//! The network stack processes all waiting frames before it yields. If frames arrived faster than it processes them, no
//! other task would run any more: no port would be served, no deadline kept, and the watchdog not fed.

use core::task::Context;

use embassy_net_driver::{Capabilities, Driver, HardwareAddress, LinkState};

use super::gateway::Gateway;

/// The controller, and the number of frames that may still be read in this turn.
pub struct Fair<'a, D> {
    device: D,
    gateway: &'a Gateway,
    left: usize,
}

impl<'a, D: Driver> Fair<'a, D> {
    /// Limits `device`; notifies `gateway` if frames are left at the end of a turn.
    pub fn new(device: D, gateway: &'a Gateway) -> Self {
        Self { device, gateway, left: FRAMES }
    }
}

impl<D: Driver> Driver for Fair<'_, D> {
    type RxToken<'a>
        = D::RxToken<'a>
    where
        Self: 'a;
    type TxToken<'a>
        = D::TxToken<'a>
    where
        Self: 'a;

    fn receive(&mut self, cx: &mut Context<'_>) -> Option<(Self::RxToken<'_>, Self::TxToken<'_>)> {
        let Some(left) = self.left.checked_sub(1) else {
            self.gateway.more_waits();
            cx.waker().wake_by_ref();
            return None;
        };
        self.left = left;
        self.device.receive(cx)
    }

    fn transmit(&mut self, cx: &mut Context<'_>) -> Option<Self::TxToken<'_>> {
        self.device.transmit(cx)
    }

    /// The network stack calls this once in each turn, after reading frames.
    fn link_state(&mut self, cx: &mut Context<'_>) -> LinkState {
        self.left = FRAMES;
        self.device.link_state(cx)
    }

    fn capabilities(&self) -> Capabilities {
        self.device.capabilities()
    }

    fn hardware_address(&self) -> HardwareAddress {
        self.device.hardware_address()
    }
}

/// Maximum number of frames in a turn: more than fit into a board's receive ring, and about 100 µs of work.
const FRAMES: usize = 16;

#[cfg(test)]
mod tests {
    use core::cell::Cell;
    use core::future::Future;
    use core::pin::pin;
    use core::task::{Context, Waker};
    use std::boxed::Box;

    use embassy_net::{Config, StackResources};
    use embassy_net_driver::{RxToken, TxToken};

    use super::*;
    use crate::tasks::test_clock::TestClock;

    /// Always has another frame, for another station.
    struct Endless<'a>(&'a Cell<u32>);
    struct Token;

    impl RxToken for Token {
        fn consume<R, F: FnOnce(&mut [u8]) -> R>(self, take: F) -> R {
            take(&mut [0xA5; 60])
        }
    }

    impl TxToken for Token {
        fn consume<R, F: FnOnce(&mut [u8]) -> R>(self, len: usize, fill: F) -> R {
            fill(&mut std::vec![0; len])
        }
    }

    impl Driver for Endless<'_> {
        type RxToken<'a>
            = Token
        where
            Self: 'a;
        type TxToken<'a>
            = Token
        where
            Self: 'a;

        fn receive(&mut self, _: &mut Context<'_>) -> Option<(Token, Token)> {
            assert!(self.0.get() < 1_000, "nothing else runs any more");
            self.0.set(self.0.get() + 1);
            Some((Token, Token))
        }

        fn transmit(&mut self, _: &mut Context<'_>) -> Option<Token> {
            Some(Token)
        }

        fn link_state(&mut self, _: &mut Context<'_>) -> LinkState {
            LinkState::Up
        }

        fn capabilities(&self) -> Capabilities {
            let mut capabilities = Capabilities::default();
            capabilities.max_transmission_unit = 1514;
            capabilities
        }

        fn hardware_address(&self) -> HardwareAddress {
            HardwareAddress::Ethernet([2, 0, 0, 0, 0, 1])
        }
    }

    #[test]
    fn a_flood_of_frames_lets_the_other_tasks_run() {
        let _clock = TestClock::take();
        let gateway = Box::new(Gateway::idle());
        let taken = Cell::new(0);
        let mut resources = StackResources::<1>::new();
        let device = Fair::new(Endless(&taken), &gateway);
        let (_, mut runner) = embassy_net::new(device, Config::default(), &mut resources, 1);
        let mut running = pin!(runner.run());
        for turn in 1..=10 {
            assert!(running.as_mut().poll(&mut Context::from_waker(Waker::noop())).is_pending());
            assert_eq!(taken.get(), turn * FRAMES as u32);
        }
    }
}
