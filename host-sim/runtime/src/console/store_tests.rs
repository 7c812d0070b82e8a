//! A store that is opened again, also in the middle of a change.

use super::*;
use recipe_test_kit::names;

fn open(folder: &Path, text: &str) -> RevisionStore {
    let mut store = RevisionStore::open(Some(folder), ("cell.toml", text)).unwrap();
    store.has_started().unwrap();
    store
}

fn live(store: &RevisionStore) -> &str {
    store.text(store.index.live).unwrap()
}

#[test]
fn what_was_live_is_live_again_unless_the_file_was_changed() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let mut store = open(folder, "one");
    assert_eq!((live(&store), store.index.previous), ("one", None));
    store.keep(2, "two", "127.0.0.1", None).unwrap();
    assert_eq!(live(&store), "one");
    drop(store);
    let mut store = open(folder, "one");
    assert_eq!(live(&store), "one");
    store.mark(2, 1).unwrap();
    drop(store);
    let store = open(folder, "one");
    assert_eq!((live(&store), store.index.previous), ("two", Some(1)));
    assert_eq!(store.revisions().unwrap().live(), 2);
    drop(store);
    // Somebody edits the file.
    let store = open(folder, "three");
    assert_eq!((live(&store), store.index.previous), ("three", Some(2)));
    assert_eq!(store.entries().last().map(|entry| entry.from.as_str()), Some("cell.toml"));
    drop(store);
    assert_eq!(live(&open(folder, "three")), "three");
}

#[test]
fn a_change_that_was_cut_off_has_not_happened() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let mut store = open(folder, "one");
    for number in 2..=8 {
        store.keep(number, "more", "127.0.0.1", None).unwrap();
    }
    drop(store);
    // The text was written, the index was not.
    fs::write(folder.join("revision-9.toml"), "nine").unwrap();
    let mut store = open(folder, "one");
    assert!(!folder.join("revision-9.toml").exists());
    // The index was written, the old text was not removed.
    store.keep(9, "nine", "127.0.0.1", Some(2)).unwrap();
    drop(store);
    fs::write(folder.join("revision-2.toml"), "two").unwrap();
    let store = open(folder, "one");
    assert_eq!(store.texts().keys().copied().collect::<Vec<_>>(), [1, 3, 4, 5, 6, 7, 8, 9]);
    let mut expected: Vec<String> = [1, 3, 4, 5, 6, 7, 8, 9].map(name).into();
    expected.splice(0..0, ["lock".to_owned()]);
    expected.push(INDEX.to_owned());
    expected.sort();
    assert_eq!(names(folder), expected);
    drop(store);
    // A changed file takes the place of the oldest that nobody needs.
    let store = open(folder, "ten");
    assert_eq!(store.texts().keys().copied().collect::<Vec<_>>(), [1, 4, 5, 6, 7, 8, 9, 10]);
    assert_eq!((live(&store), store.index.previous), ("ten", Some(1)));
}

#[test]
fn a_file_that_did_not_start_takes_nobodys_place() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    drop(open(folder, "one"));
    let store = RevisionStore::open(Some(folder), ("cell.toml", "two")).unwrap();
    assert_eq!(live(&store), "two");
    drop(store);
    let store = open(folder, "one");
    assert_eq!((live(&store), store.entries().len()), ("one", 1));
}

#[test]
fn a_folder_is_for_one_process_and_must_make_sense() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let store = open(folder, "one");
    let error = RevisionStore::open(Some(folder), ("cell.toml", "one")).unwrap_err().to_string();
    assert!(error.contains("another process uses this folder"), "{error}");
    drop(store);
    let index = fs::read_to_string(folder.join(INDEX)).unwrap();
    for (text, expected) in [
        ("{".to_owned(), "revisions.json: EOF"),
        (index.replace("\"live\": 1", "\"live\": 2"), "the live revision 2 is not kept"),
        (
            index.replace("\"number\": 1", "\"number\": 5").replace("\"live\": 1", "\"live\": 5"),
            "revision-5.toml: ",
        ),
        (
            index
                .replace("\"number\": 1", "\"number\": 4294967295")
                .replace("\"live\": 1", "\"live\": 4294967295"),
            "rising numbers below 4294967295",
        ),
    ] {
        fs::write(folder.join(INDEX), text).unwrap();
        let error = RevisionStore::open(Some(folder), ("cell.toml", "one")).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
}

#[test]
fn without_a_folder_it_is_in_memory() {
    let mut store = RevisionStore::open(None, ("cell.toml", "one")).unwrap();
    store.keep(2, "two", "127.0.0.1", None).unwrap();
    store.mark(2, 1).unwrap();
    assert_eq!(live(&store), "two");
}

/// The index with pieces replaced by others, by chance and the same in each run.
#[test]
fn any_index_is_refused_in_one_line_or_makes_sense() {
    const PIECES: [&str; 16] = [
        "0",
        "1",
        "2",
        "-1",
        "4294967295",
        "4294967296",
        "1e3",
        "null",
        "\"\"",
        "{",
        "}",
        "[]",
        ",",
        "\"live\"",
        "x",
        "\n",
    ];
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let mut store = open(folder, "one");
    store.keep(2, "two", "127.0.0.1", None).unwrap();
    store.mark(2, 1).unwrap();
    store.mark(1, 2).unwrap();
    drop(store);
    fs::write(folder.join(name(u32::MAX)), "most").unwrap();
    let right = fs::read_to_string(folder.join(INDEX)).unwrap();
    let mut seed = 1_u64;
    let mut below = |count: usize| {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (seed >> 33) as usize % count
    };
    let (mut taken, mut refused) = (0, 0);
    for round in 0..1_500 {
        let mut text = right.clone();
        // Numbers, which stand behind a colon, are hit more often than by chance.
        let values = right.match_indices(": ").map(|(at, _)| at + 2);
        let numbers: Vec<_> = values.filter(|at| right.as_bytes()[*at].is_ascii_digit()).collect();
        for _ in 0..=below(2) {
            let at = if round % 2 == 0 { numbers[below(numbers.len())] } else { below(text.len()) };
            let at = at.min(text.len() - 1);
            text.replace_range(at..(at + 1 + below(8) / 7).min(text.len()), PIECES[below(PIECES.len())]);
        }
        fs::write(folder.join(INDEX), &text).unwrap();
        for number in [1, 2, u32::MAX] {
            fs::write(folder.join(name(number)), number.to_string()).unwrap();
        }
        // The file is the same as before, or a person has changed it.
        match RevisionStore::open(Some(folder), ("cell.toml", ["one", "new"][below(2)])) {
            Ok(store) => {
                let revisions = store.revisions().expect("it makes sense");
                assert_eq!(revisions.live(), store.index.live, "{text}");
                assert!(store.entries().iter().all(|entry| store.text(entry.number).is_some()), "{text}");
                taken += 1;
            }
            Err(error) => {
                let error = error.to_string();
                assert!(
                    error.starts_with("--console-state ") && !error.contains('\n'),
                    "{error:?} of {text}"
                );
                refused += 1;
            }
        }
    }
    assert!(taken > 100 && refused > 100, "{taken} taken, {refused} refused");
}
