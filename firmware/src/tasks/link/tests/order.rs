//! Data that arrived before a deadline is handled before it, in whatever order the tasks run.

use embassy_net::tcp::TcpSocket;
use embassy_sync::blocking_mutex::raw::NoopRawMutex;
use embassy_sync::signal::Signal;

use super::*;
use crate::tasks::test_executor::{Executor, WakeOrder};

/// How long a controller's client may be silent (proto-core/docs/engine.md section 9).
const SILENCE: Duration = Duration::from_secs(2);

/// The processors of the gateway and the controller.
struct Pair<'a> {
    gateway: Executor<'a>,
    controller: Executor<'a>,
}

impl Pair<'_> {
    /// Advances time and runs both.
    fn run(&mut self, time: Duration) {
        for _ in 0..time.as_millis() {
            advance(Duration::from_millis(1));
            self.settle();
        }
    }

    fn settle(&mut self) {
        for _ in 0..10 {
            self.gateway.settle();
            self.controller.settle();
        }
    }
}

#[test]
fn bytes_that_wait_in_the_ethernet_controller_are_heard_before_silence_is_too_long() {
    for order in WakeOrder::ALL {
        let _clock = TestClock::take();
        let config = config(tcp_listen(), FirstSpeaker::Frames);
        let mut gateway = Box::new(Gateway::idle());
        gateway.configure(&config).unwrap();
        let gateway = &*gateway;
        let (link, kind) = gateway.links().find(|(_, kind)| listens(*kind)).unwrap();
        let endpoint = Endpoint::of(&config, kind);
        let watch = TaskWatch::<2>::new();
        let pulses = [TaskName::Engine, TaskName::Link(kind)].map(|name| watch.register(name).unwrap());
        let wire = Rc::new(Wire::new());
        let mut resources: [Resources; 2] = core::array::from_fn(|_| StackResources::new());
        let [of_gateway, of_controller] = &mut resources;
        let (own, mut own_runner) = host(&wire, GATEWAY, of_gateway);
        let (controller, mut controller_runner) = host(&wire, CONTROLLER, of_controller);
        let mut memory = [0; LinkBuffers::ALL];
        let buffers = LinkBuffers::take(&mut memory.as_mut_slice(), &endpoint).unwrap();
        let (mut rx, mut tx) = ([0; 256], [0; 256]);
        let speak = Signal::<NoopRawMutex, ()>::new();
        let mut pair = Pair { gateway: Executor::new(order), controller: Executor::new(order) };
        pair.gateway.spawn(gateway.keep_time(pulses[0]));
        pair.gateway.spawn(run(gateway, pulses[1], link, own, &endpoint, buffers));
        pair.gateway.spawn(own_runner.run());
        pair.controller.spawn(controller_runner.run());
        pair.controller.spawn(async {
            let mut client = TcpSocket::new(controller, &mut rx, &mut tx);
            client.connect(gateway_port()).await.unwrap();
            loop {
                speak.wait().await;
                client.write(&FRAME).await.unwrap();
            }
        });
        let net = Net { gateway, link, controller, other_host: controller, wire: &wire };
        pair.run(Duration::from_millis(100));
        speak.signal(());
        pair.settle();
        assert_eq!(net.link().2.received, 1);
        pair.run(SILENCE - Duration::from_millis(20));
        for round in 2..10 {
            // It sent in time, but the gateway's processor was busy, or read the time just before the
            // interrupt.
            speak.signal(());
            if round % 2 == 0 {
                pair.controller.settle();
                advance(Duration::from_millis(50));
            } else {
                advance(Duration::from_millis(50));
                pair.gateway.round();
                pair.controller.settle();
            }
            pair.settle();
            let (connects, is_up, counters) = net.link();
            assert_eq!((connects, is_up, counters.received), (1, true, round), "{order:?}");
            pair.run(SILENCE - Duration::from_millis(20));
        }
        pair.run(Duration::from_millis(40));
        assert!(!net.link().1, "silence is one");
    }
}
