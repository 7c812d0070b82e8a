//! Compares two sets of a port's counters. The model compares all counters after each input of the engine.

use proto_core::engine::PortCounters;

/// Whether any of these fields differs, without a branch for each.
macro_rules! any_differs {
    ($one:ident, $other:ident: $($name:ident)*) => {
        ($($one.$name ^ $other.$name)|*) != 0
    };
}

/// Whether any counter differs.
pub(super) fn differ(one: &PortCounters, other: &PortCounters) -> bool {
    any_differs!(one, other:
        frames_in
        bytes_in
        frames_out
        bytes_out
        rejected_not_finite
        rejected_out_of_range
        rejected_id
        rejected_length
        rejected_remote
        rejected_checksum
        rejected_unreadable
        rejected_other_device
        rejected_counter
        rejected_fields
        fields_without_value
        rejected_no_input
        tail_mismatches
        resync_bytes
        discarded_bytes
        asleep
        masked
        counter_jumps
        ignored
        edges_lost
        values_expired
        undelivered
        withheld
        skipped_cycles
        stale_cycles
        unanswered
        refused
        timeouts
        downs
        bus_offs
        commands
        commands_dropped
        commands_unknown
        commands_based
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_counter_is_compared() {
        let none = serde_json::to_value(PortCounters::default()).unwrap();
        let names: Vec<String> = none.as_object().unwrap().keys().cloned().collect();
        assert!(names.len() > 30 && !differ(&PortCounters::default(), &PortCounters::default()));
        for name in names {
            let mut one = none.clone();
            one[&name] = 1.into();
            let one: PortCounters = serde_json::from_value(one).unwrap();
            assert!(differ(&one, &PortCounters::default()), "{name}");
            assert!(!differ(&one, &one.clone()), "{name}");
        }
    }
}
