use super::*;
use std::vec;
use std::vec::Vec as Bytes;

fn id(name: &str) -> Id {
    Id::new(name).unwrap()
}

fn of(name: &str) -> VarRange {
    VarRange::parse(name).unwrap()
}

/// A document that uses every field.
pub(crate) fn full() -> NodeDocument {
    let mut settings = Settings::new(id("hall 1"), id("press 4"));
    settings.login = Some((Credential::new("press").unwrap(), Credential::new("cold steel").unwrap()));
    settings.primary_host = Some(id("scada"));
    settings.keep_alive = Duration::from_secs(65_535);
    let rule = |name, dead_band, min_interval| PublishRule { vars: of(name), dead_band, min_interval };
    NodeDocument {
        host: Host::try_from("broker.plant-1.example").unwrap(),
        port: 1883,
        settings,
        sample: Duration::from_millis(100),
        interval: Duration::from_millis(500),
        counter_interval: Duration::from_secs(3_600),
        time_server: Some((Host::try_from("10.0.0.1").unwrap(), 123)),
        values: [of("RobotState[1..6]")].into_iter().collect(),
        rules: [
            rule("ForceEnd[1..6]", 0.5, None),
            rule("FloatInputReg[3]", 0.0, Some(Duration::from_millis(250))),
        ]
        .into_iter()
        .collect(),
    }
}

fn bytes_of(document: &NodeDocument) -> Bytes<u8> {
    document.encode(&mut [0xA5; MAX_DOCUMENT]).unwrap().to_vec()
}

fn read(bytes: &[u8]) -> Result<Option<NodeDocument>, DocumentError> {
    let mut document = NodeDocument::empty();
    document.decode(bytes).map(|tells| tells.then_some(document))
}

#[test]
fn what_is_written_is_read() {
    assert_eq!(read(&bytes_of(&full())), Ok(Some(full())));
    let mut least = full();
    (least.settings.login, least.settings.primary_host, least.time_server) = (None, None, None);
    least.values.clear();
    least.rules.clear();
    assert_eq!(read(&bytes_of(&least)), Ok(Some(least)));
    assert_eq!(read(&OFF), Ok(None));
}

/// Boards store these bytes across updates: don't change them, add a version.
#[test]
fn version_1_has_these_bytes() {
    let mut small = full();
    small.host = Host::try_from("b").unwrap();
    small.settings = Settings::new(id("g"), id("n"));
    small.time_server = None;
    small.values.clear();
    small.rules.clear();
    let expected = b"RGWE\x01\x01\x01b\x5b\x07\x03g/n\x00\x1e\x00\x01g\x01n\x00\
                     \x64\x00\x00\x00\xf4\x01\x00\x00\x80\xee\x36\x00\x00\x00\x00";
    assert_eq!(bytes_of(&small), expected);
}

#[test]
fn cut_or_longer_bytes_are_refused() {
    let bytes = bytes_of(&full());
    for len in 0..bytes.len() {
        assert_eq!(read(&bytes[..len]), Err(DocumentError::Short), "{len}");
    }
    let longer = [&bytes[..], &[0]].concat();
    assert_eq!(read(&longer), Err(DocumentError::Behind { count: 1 }));
    assert_eq!(read(&[0; MAX_DOCUMENT + 1]), Err(DocumentError::Long { len: MAX_DOCUMENT + 1 }));
    assert_eq!(read(b"RGWF\x01\x00"), Err(DocumentError::Magic));
    assert_eq!(read(b"RGWE\x02\x00"), Err(DocumentError::Version { found: 2 }));
    assert_eq!(read(b"RGWE\x01\x02"), Err(DocumentError::Value { of: "what it is" }));
}

#[test]
fn the_longest_document_has_room() {
    let mut document = full();
    let text = Credential::new(&"x".repeat(crate::node::MAX_TEXT)).unwrap();
    let name = id(&"n".repeat(64));
    document.host = Host::try_from(&*"h".repeat(MAX_HOST)).unwrap();
    document.time_server = Some((document.host.clone(), 123));
    let settings = &mut document.settings;
    (settings.group, settings.node, settings.primary_host) = (name.clone(), name.clone(), Some(name));
    (settings.client_id, settings.login) = (text.clone(), Some((text.clone(), text)));
    document.values = (0..MAX_RULES).map(|_| of("RobotState[1..6]")).collect();
    let interval = Some(Duration::from_secs(1));
    let rule = PublishRule { vars: of("ForceEnd[1..6]"), dead_band: 0.5, min_interval: interval };
    document.rules = (0..MAX_RULES).map(|_| rule).collect();
    assert_eq!(read(&bytes_of(&document)), Ok(Some(document)));
}

#[test]
fn what_cannot_be_is_refused_with_its_place() {
    let wrong = |change: &dyn Fn(&mut NodeDocument), of: &'static str| {
        let mut document = full();
        change(&mut document);
        let mut buf = vec![0; MAX_DOCUMENT];
        assert_eq!(document.encode(&mut buf), Err(DocumentError::Value { of }));
    };
    wrong(&|document| document.host.clear(), "the broker");
    wrong(&|document| document.host = Host::try_from("a b").unwrap(), "the broker");
    wrong(&|document| document.host = Host::try_from("::1").unwrap(), "the broker");
    wrong(&|document| document.port = 0, "the port");
    wrong(&|document| document.settings.client_id = Credential::default(), "the client's name");
    wrong(&|document| document.settings.client_id = Credential::new("a\0").unwrap(), "the client's name");
    wrong(&|document| document.settings.keep_alive = Duration::from_secs(4), "the keep-alive");
    wrong(&|document| document.sample = Duration::from_millis(99), "the sample's time");
    wrong(&|document| document.interval = Duration::from_millis(3_600_001), "the interval");
    wrong(&|document| document.counter_interval = Duration::ZERO, "the counters' interval");
    wrong(&|document| document.time_server = Some((Host::new(), 123)), "the time server");
    wrong(&|document| document.time_server = Some((document.host.clone(), 0)), "the port");
    wrong(&|document| document.values[0] = of("FloatInputReg[1]"), "the values");
    wrong(&|document| document.rules[0].dead_band = f64::NAN, "a dead band");
    wrong(&|document| document.rules[0].dead_band = -0.5, "a dead band");
    wrong(&|document| document.rules[1].min_interval = Some(Duration::ZERO), "a rule's interval");
}

#[test]
fn a_login_is_not_printed() {
    let text = std::format!("{:?}", full());
    assert!(!text.contains("cold steel"), "{text}");
}

proptest::proptest! {
    #[test]
    fn bytes_that_are_read_are_written_the_same(place in 0_usize..256, byte: u8) {
        let mut bytes = bytes_of(&full());
        let len = bytes.len();
        bytes[place % len] = byte;
        if let Ok(Some(document)) = read(&bytes) {
            proptest::prop_assert_eq!(bytes_of(&document), bytes);
        }
    }

    #[test]
    fn any_bytes_are_taken(bytes in proptest::collection::vec(proptest::num::u8::ANY, 0..400)) {
        let _ = read(&bytes);
        let _ = read(&[&b"RGWE\x01\x01"[..], &bytes].concat());
    }
}
