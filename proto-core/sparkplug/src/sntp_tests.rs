use super::*;

const UTC_MS: u64 = 1_750_000_000_250;

/// A valid reply to a request, with this time.
fn reply(request: &[u8; PACKET], utc_ms: u64) -> [u8; PACKET] {
    let mut reply = [0; PACKET];
    (reply[0], reply[1]) = (0x24, 2);
    reply[24..32].copy_from_slice(&request[40..]);
    let since_1900 = utc_ms / 1_000 + FROM_1900_TO_1970;
    reply[40..44].copy_from_slice(&(since_1900 as u32).to_be_bytes());
    let fraction = ((utc_ms % 1_000) << 32).div_ceil(1_000);
    reply[44..].copy_from_slice(&(fraction as u32).to_be_bytes());
    reply
}

fn at(ms: u64) -> Instant {
    Instant::from_millis(ms)
}

#[test]
fn a_reply_tells_the_time_with_half_of_its_way() {
    let mut sntp = Sntp::new(7);
    let request = sntp.poll(at(100)).unwrap();
    assert_eq!((request[0], &request[1..40]), (0x23, &[0; 39][..]));
    assert_eq!(sntp.poll(at(100)), None);
    assert_eq!(sntp.receive(at(140), &reply(&request, UTC_MS)), Ok(UTC_MS + 20));
    assert_eq!(sntp.deadline(), at(140) + USUAL);
    // A repeated reply answers no request.
    assert_eq!(sntp.receive(at(141), &reply(&request, UTC_MS)), Err(ReplyError::Originate));
    assert_eq!(sntp.counters(), SntpCounters { requests: 1, replies: 1, refused: 1 });
}

#[test]
fn what_is_wrong_tells_nothing_and_the_right_one_is_still_taken() {
    let mut sntp = Sntp::new(7);
    let request = sntp.poll(at(100)).unwrap();
    let right = reply(&request, UTC_MS);
    let with = |place: usize, byte: u8| {
        let mut wrong = right;
        wrong[place] = byte;
        wrong
    };
    let mode = |first| (with(0, first), ReplyError::Mode { first });
    let none = reply(&request, 0);
    let mut zero = right;
    zero[40..].fill(0);
    for (wrong, error) in [
        mode(0x23),
        mode(0x25),
        mode(0x0C),
        mode(0x2C),
        (with(0, 0xE4), ReplyError::Unsynchronised),
        (with(1, 16), ReplyError::Unsynchronised),
        (with(31, !right[31]), ReplyError::Originate),
        (with(24, !right[24]), ReplyError::Originate),
        (zero, ReplyError::Time),
        (none, ReplyError::Time),
        (reply(&request, 1_704_067_199_999), ReplyError::Time),
    ] {
        assert_eq!(sntp.receive(at(110), &wrong), Err(error));
    }
    for len in 0..PACKET {
        assert_eq!(sntp.receive(at(110), &right[..len]), Err(ReplyError::Short { len }));
    }
    // An authenticator may follow, and version 3 is accepted too.
    let mut long = [0; 68];
    long[..PACKET].copy_from_slice(&with(0, 0x1C));
    assert_eq!(sntp.receive(at(110), &long), Ok(UTC_MS + 5));
}

#[test]
fn the_era_after_2036_is_known() {
    let mut sntp = Sntp::new(7);
    let request = sntp.poll(at(0)).unwrap();
    // In 2040 the seconds have wrapped.
    let of_2040 = 2_208_988_800_000;
    assert_eq!(sntp.receive(at(0), &reply(&request, of_2040)), Ok(of_2040));
}

#[test]
fn a_server_that_is_silent_is_asked_less_and_less() {
    let mut sntp = Sntp::new(9);
    let (mut now, mut pauses) = (at(0), std::vec::Vec::new());
    for _ in 0..12 {
        assert!(sntp.poll(now).is_some());
        pauses.push(sntp.deadline().saturating_since(now).as_millis());
        now = sntp.deadline();
    }
    for (nth, pause) in pauses.iter().enumerate() {
        let most = 4_000_u64 << nth.min(8);
        assert!((most * 3 / 4..=most).contains(pause), "{pauses:?}");
    }
}

#[test]
fn one_who_sends_a_kiss_is_left_alone_for_an_hour() {
    let mut sntp = Sntp::new(9);
    let request = sntp.poll(at(0)).unwrap();
    let mut kiss = reply(&request, UTC_MS);
    kiss[1] = 0;
    kiss[12..16].copy_from_slice(b"RATE");
    // A kiss-o'-death without our stamp is refused.
    let mut foreign = kiss;
    foreign[27] ^= 1;
    assert_eq!(sntp.receive(at(5), &foreign), Err(ReplyError::Originate));
    assert!(sntp.deadline() < at(10_000));
    assert_eq!(sntp.receive(at(5), &kiss), Err(ReplyError::Kiss { code: *b"RATE" }));
    assert_eq!(sntp.deadline(), at(5) + LONGEST);
}

#[test]
fn a_reply_that_is_late_says_nothing() {
    let mut sntp = Sntp::new(9);
    let request = sntp.poll(at(0)).unwrap();
    assert_eq!(sntp.receive(at(2_001), &reply(&request, UTC_MS)), Err(ReplyError::Late));
}

proptest::proptest! {
    #[test]
    fn any_datagram_is_taken_and_none_by_chance(bytes: std::vec::Vec<u8>, ms in 0..5_000_u64) {
        let mut sntp = Sntp::new(3);
        let _ = sntp.poll(at(0));
        proptest::prop_assert!(sntp.receive(at(ms), &bytes).is_err());
    }

    #[test]
    fn any_reply_to_the_request_is_refused_or_plausible(bytes: [u8; 24], tail: [u8; 16], ms in 0..5_000_u64) {
        let mut sntp = Sntp::new(3);
        let request = sntp.poll(at(0)).unwrap();
        let whole = [&bytes[..], &request[40..], &tail[..]].concat();
        if let Ok(utc_ms) = sntp.receive(at(ms), &whole) {
            proptest::prop_assert!((PLAUSIBLE.start..PLAUSIBLE.end + 2_000).contains(&utc_ms));
        }
        proptest::prop_assert!(sntp.deadline() > at(ms) || sntp.poll(at(ms)).is_some());
    }
}
