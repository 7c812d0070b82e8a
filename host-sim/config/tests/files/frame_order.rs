//! In which order the output frames of a CAN recipe are sent, and frames without data.

use proto_core::config::Parts;
use proto_core::wire::can::CanId;
use recipe_config::file::{Text, parse_frames, parse_gateway};

/// A file with these output frames, each its id and its other keys.
fn file(frames: &[(u16, &str)]) -> String {
    let head = "[controller]\naddress = \"10.0.0.2\"\n[[recipe]]\nname = \"drive\"\nkind = \"can\"\nmode = \"user\"\n";
    let frame = |(id, keys): &(u16, &str)| format!("[[recipe.output.frame]]\nid = {id}\n{keys}\n");
    let port = "[[port]]\nname = \"p\"\nbus = \"can\"\nrecipe = \"drive\"\ncycle_ms = 10\n";
    format!("{head}{}{port}", frames.iter().map(frame).collect::<String>())
}

fn fields(name: &str) -> String {
    format!("fields = [{{ name = \"{name}\", type = \"word\", from = \"WordOutputReg[1]\" }}]")
}

/// The ids in the order in which they are sent.
#[track_caller]
fn sent(frames: &[(u16, &str)]) -> Vec<u16> {
    let fields = fields("x");
    let frames: Vec<_> = frames.iter().map(|(id, keys)| (*id, format!("{keys}\n{fields}"))).collect();
    let frames: Vec<_> = frames.iter().map(|(id, keys)| (*id, keys.as_str())).collect();
    let config = parse_gateway(Text { name: "test.toml", toml: &file(&frames) }, &[]).unwrap();
    let Parts::Can { output, .. } = &config.recipes[0].parts else { panic!() };
    let id = |id| match id {
        CanId::Standard(id) => id,
        CanId::Extended(_) => panic!(),
    };
    output.iter().map(|frame| id(frame.id)).collect()
}

#[track_caller]
fn refused(frames: &[(u16, &str)]) -> String {
    let fields = fields("x");
    let frames: Vec<_> = frames.iter().map(|(id, keys)| (*id, format!("{keys}\n{fields}"))).collect();
    let frames: Vec<_> = frames.iter().map(|(id, keys)| (*id, keys.as_str())).collect();
    parse_gateway(Text { name: "test.toml", toml: &file(&frames) }, &[]).unwrap_err().to_string()
}

#[test]
fn a_frame_is_sent_behind_the_one_that_it_names() {
    assert_eq!(sent(&[(3, ""), (1, ""), (2, "")]), [3, 1, 2], "without after as the file has them");
    assert_eq!(sent(&[(1, "after = \"target\""), (2, "name = \"target\""), (3, "")]), [2, 1, 3]);
    assert_eq!(sent(&[(1, "name = \"target\""), (2, "after = \"target\"")]), [1, 2]);
    let chain = [
        (1, "name = \"control\"\nafter = \"target\""),
        (2, "after = \"control\""),
        (3, "name = \"speed\""),
        (4, "name = \"target\"\nafter = \"speed\""),
    ];
    assert_eq!(sent(&chain), [3, 4, 1, 2]);
}

#[test]
fn what_cannot_be_sent_in_an_order_is_refused_at_its_place() {
    let of_itself = refused(&[(1, "name = \"a\"\nafter = \"a\"")]);
    assert!(
        of_itself.ends_with("a frame cannot be sent after itself, \"a\"; allowed: another output frame"),
        "{of_itself}"
    );
    assert!(of_itself.starts_with("test.toml:10:9: recipe.drive.output.frame.a.after: "), "{of_itself}");
    let unknown = refused(&[(1, "after = \"targt\""), (2, "name = \"target\"")]);
    assert!(
        unknown.contains("there is no output frame \"targt\"; there are \"target\"")
            && unknown.contains("did you mean"),
        "{unknown}"
    );
    let none = refused(&[(1, "after = \"target\"")]);
    assert!(
        none.ends_with("no output frame \"target\"; no output frame of this recipe has a name"),
        "{none}"
    );
    let twice = refused(&[(1, "name = \"a\""), (2, "name = \"a\"")]);
    assert!(twice.ends_with("there is already an output frame \"a\"; names must differ"), "{twice}");
    let circle = refused(&[
        (1, "after = \"a\""),
        (2, "name = \"a\"\nafter = \"b\""),
        (3, "name = \"b\"\nafter = \"c\""),
        (4, "name = \"c\"\nafter = \"a\""),
    ]);
    let what = "\"a\" after \"b\" after \"c\" after \"a\" is a circle; allowed: one of them without after";
    assert!(circle.ends_with(what), "{circle}");
    let name = refused(&[(1, "name = \"the target\"")]);
    assert!(name.contains("output.frame") && name.contains("name"), "{name}");
}

#[test]
fn only_output_frames_of_a_user_recipe_have_an_order() {
    let toml = file(&[(1, "after = \"a\"\nfields = []")]).replace("output", "input");
    let error = parse_gateway(Text { name: "test.toml", toml: &toml }, &[]).unwrap_err().to_string();
    assert!(error.contains("input.frame[1].after: unknown key"), "{error}");
}

/// What `check` says of the order of frames.
#[track_caller]
fn told(frames: &[(u16, &str)]) -> Vec<String> {
    let recipes = parse_frames(Text { name: "test.toml", toml: &file(frames) }, &[]).unwrap();
    recipe_config::orders_before_values(&recipes).into_iter().map(|(_, said)| said).collect()
}

#[test]
fn an_order_before_the_values_that_it_starts_is_told() {
    let (control, target) = (fields("controlword"), fields("target"));
    assert_eq!(
        told(&[(0x210, &control), (0x310, &target)]),
        [
            "recipe \"drive\": frame 0x210 with \"controlword\" is sent before frame 0x310 with \"target\", so a device can \
          start with the value of the cycle before; write name = \"target\" at 0x310 and after = \"target\" at 0x210, or an \
          after at 0x310 if this order is meant"
        ]
    );
    // By its id alone, and by its name alone.
    assert_eq!(told(&[(0x210, &fields("x")), (0x310, &target)]).len(), 1);
    assert_eq!(told(&[(0x50, &fields("Start")), (0x51, &target)]).len(), 1);
    // Another node, the right order, and one that is written.
    assert_eq!(told(&[(0x210, &control), (0x311, &target)]), [""; 0]);
    assert_eq!(told(&[(0x310, &target), (0x210, &control)]), [""; 0]);
    let (first, named) = (format!("after = \"t\"\n{control}"), format!("name = \"t\"\n{target}"));
    assert_eq!(told(&[(0x210, &first), (0x310, &named)]), [""; 0]);
    let (first, behind) = (format!("name = \"c\"\n{control}"), format!("after = \"c\"\n{target}"));
    assert_eq!(told(&[(0x210, &first), (0x310, &behind)]), [""; 0]);
    // Orders of several axes, and constants.
    assert_eq!(told(&[(0x50, &fields("cmd1")), (0x51, &fields("cmd2"))]), [""; 0]);
    let constant = "fields = [{ name = \"enable\", type = \"byte\", value = 1 }]";
    assert_eq!(told(&[(0x50, constant), (0x51, &target)]), [""; 0]);
}

#[test]
fn a_frame_without_data_is_sent_and_not_received() {
    let toml = file(&[(0x210, &fields("x")), (0x80, "fields = []")]);
    let config = parse_gateway(Text { name: "test.toml", toml: &toml }, &[]).unwrap();
    assert!(config.view().is_device(&config.recipes[0]));
    let recipes = parse_frames(Text { name: "test.toml", toml: &toml }, &[]).unwrap();
    assert_eq!(recipes[0].as_ref().unwrap().output[1].fields, []);
    let alone = file(&[(0x80, "fields = []")]);
    assert!(parse_gateway(Text { name: "test.toml", toml: &alone }, &[]).is_ok());
    for (what, toml) in [
        ("an input", toml.replace("output", "input").replace("from = \"WordOut", "to = \"WordIn")),
        ("a system recipe", alone.replace("\"user\"", "\"realtime\"")),
    ] {
        let error = parse_gateway(Text { name: "test.toml", toml: &toml }, &[]).unwrap_err().to_string();
        assert!(error.contains("no fields"), "{what}: {error}");
    }
}
