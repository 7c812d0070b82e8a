//! The bytes handed over to a TCP link that may not have arrived: how many the peer's transport still has to
//! acknowledge, and by when they must be delivered (docs/engine.md section 5).

use heapless::Deque;

use crate::engine::latency::Since;
use crate::time::Instant;

/// Transmissions in order, at most `N` of them unacknowledged.
#[derive(Debug, Clone)]
pub(crate) struct Flight<const N: usize> {
    /// Bytes handed over since the link came up, wrapping.
    total: u32,
    transmissions: Deque<Transmission, N>,
}

#[derive(Debug, Clone, Copy)]
struct Transmission {
    /// `total` after it was handed over.
    end: u32,
    /// By when it must be delivered.
    until: Instant,
    /// Since when its oldest value had waited.
    born: Since,
}

impl<const N: usize> Flight<N> {
    pub(crate) const fn new() -> Self {
        Self { total: 0, transmissions: Deque::new() }
    }

    /// A connection begins or ends: nothing is in flight.
    pub(crate) fn clear(&mut self) {
        self.total = 0;
        self.transmissions.clear();
    }

    /// `len` bytes were handed over, to be delivered before `until`, which is not earlier than that of the previous
    /// transmission. The caller has checked [`Self::is_full`].
    pub(crate) fn sent(&mut self, len: usize, until: Instant, born: Since) {
        self.total = self.total.wrapping_add(len as u32);
        let _ = self.transmissions.push_back(Transmission { end: self.total, until, born });
    }

    /// `left` of the bytes handed over are not acknowledged; a number greater than their total is ignored. Calls
    /// `arrived` for each acknowledged transmission with the time since which its oldest value had waited.
    pub(crate) fn acked(&mut self, left: u32, mut arrived: impl FnMut(Since)) {
        if left > i32::MAX as u32 {
            return;
        }
        let acked = self.total.wrapping_sub(left);
        while let Some(first) = self.transmissions.front()
            && acked.wrapping_sub(first.end) as i32 >= 0
        {
            arrived(first.born);
            self.transmissions.pop_front();
        }
    }

    /// The peer has answered everything, so everything has arrived, whatever its transport reports.
    pub(crate) fn answered(&mut self) {
        self.transmissions.clear();
    }

    /// Whether everything is acknowledged.
    pub(crate) fn is_empty(&self) -> bool {
        self.transmissions.is_empty()
    }

    /// Whether nothing more may be handed over at present.
    pub(crate) fn is_full(&self) -> bool {
        self.transmissions.is_full()
    }

    /// When the oldest transmission must be acknowledged.
    pub(crate) fn deadline(&self) -> Instant {
        self.transmissions.front().map_or(Instant::NEVER, |first| first.until)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: fn(u64) -> Instant = Instant::from_millis;

    #[test]
    fn what_is_acknowledged_leaves_in_order_and_the_oldest_names_the_deadline() {
        let mut flight = Flight::<3>::new();
        assert!(flight.is_empty() && flight.deadline() == Instant::NEVER);
        for (len, until) in [(10, 1), (20, 2), (30, 3)] {
            flight.sent(len, MS(until), Since::NONE);
        }
        assert!(flight.is_full());
        flight.acked(55, |_| ());
        assert_eq!(flight.deadline(), MS(1), "half a transmission is none");
        flight.acked(49, |_| ());
        assert_eq!(flight.deadline(), MS(2));
        flight.acked(0, |_| ());
        assert!(flight.is_empty());
    }

    #[test]
    fn the_count_of_bytes_may_wrap() {
        let mut flight = Flight::<2>::new();
        for _ in 0..70_000 {
            flight.sent(65_536, MS(5), Since::NONE);
            flight.acked(0, |_| ());
        }
        flight.sent(100, MS(7), Since::at(MS(6)));
        flight.acked(100, |_| ());
        assert_eq!(flight.deadline(), MS(7));
        let mut took = None;
        flight.acked(0, |born| took = Some(born.micros_until(MS(9))));
        assert_eq!(took, Some(3_000));
        assert!(flight.is_empty());
    }
}
