//! Update files: made of ELF files, shown, refused.

use std::path::{Path, PathBuf};

use recipe_ctl::{Failure, Firmware, Slot, TableView, Update, Verdict, sign, signing_key};

const VIEW: TableView = TableView { width: None, is_terminal: false };

/// An ELF file of an Arm core with these segments.
fn elf(segments: &[(u32, Vec<u8>)]) -> Vec<u8> {
    let (head, entry) = (52, 32);
    let mut bytes = b"\x7FELF\x01\x01\x01".to_vec();
    bytes.resize(16, 0);
    let half = |bytes: &mut Vec<u8>, value: u16| bytes.extend(value.to_le_bytes());
    let word = |bytes: &mut Vec<u8>, value: u32| bytes.extend(value.to_le_bytes());
    half(&mut bytes, 2);
    half(&mut bytes, 40);
    for value in [1, 0, head, 0, 0] {
        word(&mut bytes, value);
    }
    for value in [head as u16, entry as u16, segments.len() as u16, 40, 0, 0] {
        half(&mut bytes, value);
    }
    let mut at = head + entry * segments.len() as u32;
    for (address, data) in segments {
        let len = data.len() as u32;
        for value in [1, at, *address, *address, len, len, 5, 4] {
            word(&mut bytes, value);
        }
        at += len;
    }
    segments.iter().for_each(|(_, data)| bytes.extend(data));
    bytes
}

/// A program at this address: a vector table, and bytes.
fn program(start: u32, stack: u32) -> Vec<(u32, Vec<u8>)> {
    let mut code = [stack, start + 9].iter().flat_map(|word| word.to_le_bytes()).collect::<Vec<u8>>();
    code.extend((0..5_000).map(|at| at as u8));
    vec![(start, code), (start + 5_100, vec![0x11; 77])]
}

const A: u32 = 0x0802_0400;
const B: u32 = 0x0810_0400;
const STACK: u32 = 0x2002_0000;

pub(crate) struct Folder {
    folder: tempfile::TempDir,
    firmware: Firmware,
}

impl Folder {
    pub(crate) fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        signing_key::make(&path("key")).unwrap();
        let firmware = Firmware {
            key: path("key"),
            board: "nucleo-h743zi".to_owned(),
            version: "0.3.0".to_owned(),
            slot_a: path("a.elf"),
            slot_b: path("b.elf"),
            reads: None,
            writes: None,
        };
        let made = Self { folder, firmware };
        made.put("a.elf", &program(A, STACK));
        made.put("b.elf", &program(B, STACK));
        made
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn put(&self, name: &str, segments: &[(u32, Vec<u8>)]) {
        std::fs::write(self.path(name), elf(segments)).unwrap();
    }

    pub(crate) fn update(&self) -> Update {
        let path = self.path("update.rgu");
        std::fs::write(&path, sign(&self.firmware).unwrap()).unwrap();
        Update::read(&path).unwrap()
    }

    #[track_caller]
    fn refused(&self, words: &str) {
        match sign(&self.firmware) {
            Err(Failure::Wrong(message)) => assert!(message.contains(words), "{message}"),
            other => panic!("{other:?}"),
        }
    }
}

#[test]
fn an_update_has_what_was_linked_for_each_slot() {
    let folder = Folder::new();
    let update = folder.update();
    let public = folder.path("key.pub");
    let answer = update.inspect(Some(&public), VIEW).unwrap();
    assert_eq!(answer.verdict(), Verdict::Well);
    let text = answer.text(VIEW);
    assert!(text.contains("firmware        0.3.0\n") && text.contains("reads versions 3 to"), "{text}");
    assert_eq!(text.matches("of this key").count(), 2, "{text}");
    for (slot, start) in [(Slot::A, A), (Slot::B, B)] {
        let (address, flat) = update.flat(slot).unwrap();
        assert_eq!((address + 1024, &flat[192..1024]), (start, &[0xFF; 832][..]));
        let image = &flat[1024..];
        let [(_, first), (_, second)] = &program(start, STACK)[..] else { panic!() };
        assert_eq!((image.len(), &image[..first.len()]), (5_177, &first[..]));
        assert_eq!((&image[first.len()..5_100], &image[5_100..]), (&[0xFF; 92][..], &second[..]));
    }
    // Without the key nothing is claimed.
    let answer = update.inspect(None, VIEW).unwrap();
    assert!(answer.text(VIEW).contains("not checked") && answer.json().contains("\"version\":\"0.3.0\""));
}

#[test]
fn another_key_and_a_changed_byte_are_told() {
    let folder = Folder::new();
    let update = folder.update();
    signing_key::make(&folder.path("other")).unwrap();
    let answer = update.inspect(Some(&folder.path("other.pub")), VIEW).unwrap();
    assert_eq!(
        (answer.verdict(), answer.text(VIEW).matches("of another key").count()),
        (Verdict::Trouble, 2)
    );
    let mut bytes = std::fs::read(folder.path("update.rgu")).unwrap();
    bytes[16 + 192 + 100] ^= 4;
    let answer = Update::of(bytes).unwrap().inspect(None, VIEW).unwrap();
    assert_eq!(
        (answer.verdict(), answer.text(VIEW).matches("its CRC differs").count()),
        (Verdict::Trouble, 1)
    );
    let path = folder.path("cut.rgu");
    std::fs::write(&path, &std::fs::read(folder.path("update.rgu")).unwrap()[..9_000]).unwrap();
    let error = Update::read(&path).unwrap_err();
    assert!(
        error.message().contains("cut.rgu: the update file has 9000 bytes and says that it has"),
        "{error:?}"
    );
}

#[test]
fn programs_for_another_place_are_refused() {
    let mut folder = Folder::new();
    let put = |name: &str, segments: &[(u32, Vec<u8>)]| folder.put(name, segments);
    put("b.elf", &program(A, STACK));
    folder.refused(
        "b.elf: bytes 08020400 to 08021790 are not within 08100400 to 081A0000: it is not linked for slot B",
    );
    put("b.elf", &program(0x0810_0000, STACK));
    folder.refused("are not within 08100400");
    put("b.elf", &[(B + 639 * 1024 - 8, vec![0; 9])]);
    folder.refused("it is not linked for slot B");
    put("b.elf", &[(B + 64, vec![0; 9])]);
    folder.refused("no vector table is at 08100400");
    put("b.elf", &[]);
    folder.refused("nothing of it is at 08100400");
    put("b.elf", &program(B, 0x3000_0000));
    folder.refused("a stack at 30000000");
    std::fs::write(folder.path("b.elf"), b"not an ELF file").unwrap();
    folder.refused("b.elf: ");
    folder.firmware.slot_b = folder.path("none.elf");
    folder.refused("none.elf: No such file");
}

#[test]
fn arguments_that_mean_nothing_are_refused() {
    let change = |change: &dyn Fn(&mut Firmware, &Path), words: &str| {
        let mut folder = Folder::new();
        let path = folder.folder.path().to_owned();
        change(&mut folder.firmware, &path);
        folder.refused(words);
    };
    change(
        &|firmware, _| firmware.board = "mps2-an385".to_owned(),
        "slots; there are nucleo-h743zi, mps2-an500",
    );
    change(&|firmware, _| firmware.version = "0.3".to_owned(), "three numbers such as 0.3.0");
    change(&|firmware, _| firmware.reads = Some((3, 2)), "cannot write 2");
    change(&|firmware, _| firmware.writes = Some(9), "cannot write 9");
    change(&|firmware, path| firmware.key = path.join("key.pub"), "its mode is 0644");
}
