//! How much there is room for, how often a sector is erased, and what is refused.

use embassy_futures::block_on;
use recipe_store::{
    FlashWord, Geometry, KeepError, MAX_DATA, Marks, MountError, PutError, RecordKey, Role, Store, Trial,
    TrialEnd,
};

use crate::bench::{Change, StoreBench, image};
use crate::model::{Nor, Torn};
use crate::{SECTORS, SMALL};

/// Keeps, tries and confirms `count` images; returns how many for one erase of one sector.
fn wear(count: u32, len: usize) -> f64 {
    let mut bench = StoreBench::new(SECTORS, Torn::Fault);
    let mut live = None;
    for number in 1..=count {
        let trial = |attempts| {
            let trial = Some(Trial { number, attempts, confirm_s: 60 });
            Marks { live, trial, ..Marks::default() }
        };
        let image = image(number, len);
        while let Err(KeepError::Put(PutError::Full { .. })) = bench.store.keep(number, 0, &image, None) {
            let put = bench.store.forget(None).unwrap().expect("an old one");
            block_on(put.execute(&mut bench.flash)).unwrap();
        }
        assert!(bench.attempt(&Change::Keep { number, image }));
        assert!(bench.attempt(&Change::Mark(trial(3))) && bench.attempt(&Change::Mark(trial(2))));
        live = Some(number);
        assert!(bench.attempt(&Change::Mark(Marks { live, ..Marks::default() })));
    }
    f64::from(count) / (f64::from(bench.flash.erases) / f64::from(SECTORS.sectors))
}

#[test]
fn seven_of_the_longest_images_are_kept_and_the_oldest_gives_way() {
    let mut bench = StoreBench::new(SECTORS, Torn::Fault);
    for number in 1..=30 {
        let image = image(number, MAX_DATA);
        loop {
            match bench.store.keep(number, 0, &image, None) {
                Ok(put) => {
                    block_on(put.execute(&mut bench.flash)).unwrap();
                    break;
                }
                Err(KeepError::Put(PutError::Full { .. })) => {
                    let put = bench.store.forget(None).unwrap().expect("an old one");
                    block_on(put.execute(&mut bench.flash)).unwrap();
                }
                Err(error) => panic!("{number}: {error}"),
            }
        }
        let marks = Marks { live: Some(number), previous: bench.store.marks().live, ..Marks::default() };
        block_on(bench.store.mark(marks).unwrap().execute(&mut bench.flash)).unwrap();
    }
    let numbers = |store: &Store| -> Vec<u32> { store.revisions().iter().map(|kept| kept.number).collect() };
    assert_eq!(numbers(&bench.store), [24, 25, 26, 27, 28, 29, 30]);
    // Also after a restart, and what is needed is not forgotten.
    let mut store = Store::mount(&bench.flash).unwrap();
    assert_eq!(numbers(&store), numbers(&bench.store));
    assert_eq!(store.forget(Some(30)).unwrap_err(), KeepError::Needed { number: 30 });
    assert!(store.forget(Some(3)).unwrap().is_none());
    println!("erases for 30 images of 16 KiB: {}", bench.flash.erases);
}

#[test]
fn sectors_last_for_ten_thousands_of_configurations() {
    for (len, count, least) in [(300, 6_000, 400.0), (2_048, 1_500, 80.0), (MAX_DATA, 200, 1.5)] {
        let figure = wear(count, len);
        println!("images of {len} bytes: {figure:.1} configurations for each erase of every sector");
        assert!(figure > least, "{len}: {figure}");
    }
    let mut bench = StoreBench::new(SECTORS, Torn::Fault);
    for number in 0..20_000 {
        assert!(bench.attempt(&Change::Counter(0, number)));
    }
    println!("20,000 counts: {} erases of a sector", bench.flash.erases);
    assert!(bench.flash.erases < 15);
}

#[test]
fn what_does_not_fit_is_refused_before_anything_is_erased() {
    let mut bench = StoreBench::new(SMALL, Torn::Fault);
    let error = (0..8).find_map(|number| {
        let image = image(number, 1_500);
        match bench.store.keep(number, 0, &image, None) {
            Ok(put) => {
                block_on(put.execute(&mut bench.flash)).unwrap();
                None
            }
            Err(error) => Some((number, error)),
        }
    });
    let (kept, error) = error.expect("the store is small");
    assert!((2..6).contains(&kept), "{kept}");
    assert!(
        matches!(error, KeepError::Put(PutError::Full { used, available }) if used > available),
        "{error}"
    );
    let erases = bench.flash.erases;
    // What is there can still be changed.
    drop(bench.store.set_counter(1, 5).unwrap());
    assert!(bench.attempt(&Change::Counter(1, 6)));
    assert_eq!((bench.store.counter(1), bench.flash.erases), (6, erases));
    assert_eq!(
        bench.store.put(RecordKey::Image(0), 0, &[0; MAX_DATA + 1]).unwrap_err(),
        PutError::TooLong { len: MAX_DATA + 1 }
    );
    assert_eq!(bench.store.put(RecordKey::Image(8), 0, &[]).unwrap_err(), PutError::Key);
    assert_eq!(bench.store.put(RecordKey::Counter(3), 0, &[]).unwrap_err(), PutError::Key);
}

#[test]
fn what_is_in_use_is_not_forgotten() {
    let mut bench = StoreBench::new(SMALL, Torn::Fault);
    for number in 1..=8 {
        bench.execute(&Change::Keep { number, image: image(number, 10) });
    }
    let trial = Some(Trial { number: 2, attempts: 1, confirm_s: 30 });
    bench.execute(&Change::Mark(Marks { live: Some(1), previous: Some(3), trial, last: None }));
    for number in 1..=3 {
        assert_eq!(bench.store.keep(9, 0, &[], Some(number)).unwrap_err(), KeepError::Needed { number });
        assert_eq!(bench.store.keep(number, 0, &[], None).unwrap_err(), KeepError::Needed { number });
    }
    assert_eq!(bench.store.keep(9, 0, &[], Some(20)).unwrap_err(), KeepError::Unknown { number: 20 });
    let unknown = Marks { live: Some(30), ..Marks::default() };
    assert_eq!(bench.store.mark(unknown).unwrap_err(), KeepError::Unknown { number: 30 });
    block_on(bench.store.keep(9, 0, b"nine", Some(6)).unwrap().execute(&mut bench.flash)).unwrap();
    block_on(bench.store.keep(10, 0, b"ten", None).unwrap().execute(&mut bench.flash)).unwrap();
    let numbers: Vec<u32> = bench.store.revisions().iter().map(|kept| kept.number).collect();
    assert_eq!(numbers, [1, 2, 3, 5, 7, 8, 9, 10], "6 was named, 4 is the oldest");
}

#[test]
fn a_trial_has_so_many_starts() {
    let mut bench = StoreBench::new(SMALL, Torn::Fault);
    for number in 1..=3 {
        bench.execute(&Change::Keep { number, image: image(number, 10) });
    }
    let trial = Some(Trial { number: 3, attempts: 2, confirm_s: 30 });
    bench.execute(&Change::Mark(Marks { live: Some(2), previous: Some(1), trial, last: None }));
    let run = |bench: &mut StoreBench| -> Vec<(u32, Role)> {
        bench.restart();
        let start = bench.store.at_start();
        if let Some(marks) = start.marks {
            bench.execute(&Change::Mark(marks));
        }
        start.candidates.iter().map(|(kept, role)| (kept.number, *role)).collect()
    };
    let without = [(2, Role::Live), (1, Role::Previous)];
    let with = [&[(3, Role::Trial { confirm_s: 30 })][..], &without].concat();
    assert_eq!(run(&mut bench), with);
    assert_eq!(run(&mut bench), with);
    assert_eq!(run(&mut bench), without);
    let marks = bench.store.marks();
    assert_eq!((marks.trial, marks.last), (None, Some((3, TrialEnd::Failed))));
    assert_eq!(run(&mut bench), without);
}

#[test]
fn a_damaged_record_is_not_there_and_the_others_are() {
    let mut bench = StoreBench::new(SMALL, Torn::Fault);
    for number in 1..=3 {
        bench.execute(&Change::Keep { number, image: image(number, 100) });
    }
    let found = bench.store.find(bench.store.revision(2).unwrap().key()).unwrap();
    bench.flash.damage(found.data);
    let store = Store::mount(&bench.flash).unwrap();
    let numbers: Vec<u32> = store.revisions().iter().map(|kept| kept.number).collect();
    assert_eq!(numbers, [1, 3]);
}

#[test]
fn a_store_of_a_newer_program_is_left_alone() {
    let mut flash = Nor::new(SMALL, Torn::Fault);
    let mut head = [0; 32];
    head[..4].copy_from_slice(b"RGSs");
    head[4] = 2;
    let check = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(&head[..28]);
    head[28..].copy_from_slice(&check.to_le_bytes());
    flash.write_now(FlashWord { sector: 1, word: 0 }, &head);
    assert_eq!(Store::mount(&flash).unwrap_err(), MountError::Version { found: 2 });
    for geometry in [
        Geometry { sectors: 1, words: 100 },
        Geometry { sectors: 9, words: 100 },
        Geometry { sectors: 3, words: 7 },
    ] {
        let error = Store::mount(&Nor::new(geometry, Torn::Fault)).unwrap_err();
        assert_eq!(error, MountError::Geometry(geometry));
    }
}
