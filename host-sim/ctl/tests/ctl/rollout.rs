//! Rollouts over simulated boards, each with its own virtual time.

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering::SeqCst};
use std::time::Duration;

use recipe_ctl::rollout::{
    BoardInfo, BoardOutcome, BoardState, Left, RolloutBoard, RolloutEvent, RolloutPlan, RolloutReport,
    RolloutStep, roll_out,
};
use recipe_ctl::update::Health;
use recipe_ctl::{Failure, MAX_AT_ONCE, Stop, TableView, Verdict};

const OLD: &str = "0.2.0";
const NEW: &str = "0.3.0";
const TRIAL: Duration = Duration::from_secs(300);
const PLAN: RolloutPlan = RolloutPlan {
    batch: 4,
    stop_on_failure: false,
    patience: Duration::from_secs(120),
    settled: Duration::from_secs(10),
};
const WIDE: TableView = TableView { width: None, is_terminal: false };

/// What goes wrong with a board.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fault {
    None,
    Unreached,
    NoHealth,
    Refuses,
    LosesConnection,
    WrongSignature,
    /// It is never seen again, and its trial ends some time.
    NeverBack,
    /// Three starts, then the firmware before.
    DoesNotRun,
    /// It is back later than anybody waits for a restart.
    SlowStart,
    /// Its links are up 40 s after the restart.
    SlowLinks,
    /// A link stays down.
    Worse,
    /// The same, and it does not go back when it is asked.
    WorseAndStays,
    ConfirmsItself,
    ConfirmRefused,
    /// It has confirmed, and the answer was lost.
    AnswerLost,
}

const FAULTS: [Fault; 15] = [
    Fault::None,
    Fault::Unreached,
    Fault::NoHealth,
    Fault::Refuses,
    Fault::LosesConnection,
    Fault::WrongSignature,
    Fault::NeverBack,
    Fault::DoesNotRun,
    Fault::SlowStart,
    Fault::SlowLinks,
    Fault::Worse,
    Fault::WorseAndStays,
    Fault::ConfirmsItself,
    Fault::ConfirmRefused,
    Fault::AnswerLost,
];

#[derive(Debug, Clone, Copy)]
struct Inside {
    now: Duration,
    good: &'static str,
    /// Since when another one runs on trial, and which.
    trial: Option<(Duration, &'static str)>,
    is_gone: bool,
    pushes: usize,
}

struct Sim {
    fault: Fault,
    inside: Mutex<Inside>,
}

impl Sim {
    fn new(fault: Fault) -> Self {
        let now = Duration::ZERO;
        Self { fault, inside: Mutex::new(Inside { now, good: OLD, trial: None, is_gone: false, pushes: 0 }) }
    }

    /// After so much time on the board.
    fn after<T>(
        &self,
        seconds: u64,
        act: impl FnOnce(&mut Inside) -> Result<T, &'static str>,
    ) -> Result<T, Failure> {
        let inside = &mut *self.inside.lock().unwrap();
        inside.pass(Duration::from_secs(seconds));
        if self.fault == Fault::Unreached || inside.is_gone {
            return Err(Failure::refused("nobody is there"));
        }
        act(inside).map_err(Failure::refused)
    }

    /// What it runs, whether or not somebody reaches it.
    fn runs(&self) -> (&'static str, bool) {
        let inside = self.inside.lock().unwrap();
        match inside.trial {
            Some((_, version)) => (version, true),
            None => (inside.good, false),
        }
    }

    fn pushes(&self) -> usize {
        self.inside.lock().unwrap().pushes
    }

    fn time(&self) -> Duration {
        self.inside.lock().unwrap().now
    }

    /// Somebody has mended it, some time later.
    fn mend(&mut self) {
        self.fault = Fault::None;
        let inside = self.inside.get_mut().unwrap();
        inside.is_gone = false;
        inside.pass(TRIAL);
    }
}

impl Inside {
    fn pass(&mut self, time: Duration) {
        self.now += time;
        if self.trial.is_some_and(|(since, _)| self.now - since >= TRIAL) {
            self.trial = None;
        }
    }
}

impl RolloutBoard for Sim {
    fn inspect(&self) -> Result<BoardInfo, Failure> {
        self.after(1, |inside| {
            let (version, state) = match inside.trial {
                Some((_, NEW)) => (NEW, BoardState::OnTrial),
                Some((_, other)) => (other, BoardState::OtherOnTrial),
                None if inside.good == NEW => (NEW, BoardState::Confirmed),
                None => (inside.good, BoardState::Other),
            };
            Ok(BoardInfo { version: version.into(), state })
        })
    }

    fn health(&self) -> Result<Health, Failure> {
        self.after(0, |inside| {
            let is_ill = match (self.fault, inside.trial) {
                (Fault::NoHealth, _) => return Err("no answer"),
                (Fault::Worse | Fault::WorseAndStays, Some(_)) => true,
                (Fault::SlowLinks, Some((since, _))) => inside.now - since < Duration::from_secs(40),
                _ => false,
            };
            let (word, links_up) = if is_ill { ("link-down", 2) } else { ("running", 3) };
            if self.fault == Fault::ConfirmsItself && inside.trial.take().is_some() {
                inside.good = NEW;
            }
            Ok(Health { word: word.into(), links_up, ports_working: 1 })
        })
    }

    fn push(&self) -> Result<(), Failure> {
        self.after(30, |inside| {
            inside.pushes += 1;
            match self.fault {
                Fault::Refuses => Err("an older version"),
                Fault::LosesConnection => Err("the connection was lost"),
                _ => Ok(()),
            }
        })
    }

    fn begin(&self) -> Result<(), Failure> {
        self.after(5, |inside| {
            match self.fault {
                Fault::WrongSignature => return Err("it is signed with another key"),
                Fault::DoesNotRun => return Err("the trial has ended: the firmware did not run"),
                _ => inside.trial = Some((inside.now, NEW)),
            }
            match self.fault {
                Fault::NeverBack => {
                    inside.is_gone = true;
                    inside.pass(Duration::from_secs(60));
                    Err("nobody is there")
                }
                Fault::SlowStart => Err("nobody is there"),
                _ => Ok(()),
            }
        })
    }

    fn confirm(&self) -> Result<(), Failure> {
        self.after(1, |inside| {
            if self.fault == Fault::ConfirmRefused {
                return Err("busy");
            }
            inside.good = inside.trial.take().ok_or("nothing is on trial")?.1;
            match self.fault {
                Fault::AnswerLost => Err("the connection was lost"),
                _ => Ok(()),
            }
        })
    }

    fn back(&self) -> Result<(), Failure> {
        self.after(10, |inside| match self.fault {
            Fault::WorseAndStays => Err("busy"),
            _ => inside.trial.take().map(|_| ()).ok_or("nothing is on trial"),
        })
    }

    fn now(&self) -> Duration {
        self.time()
    }

    fn wait(&self, time: Duration) {
        self.inside.lock().unwrap().pass(time);
    }
}

fn plant(faults: impl IntoIterator<Item = Fault>) -> Vec<(String, Sim)> {
    faults.into_iter().enumerate().map(|(nth, fault)| (format!("cell-{nth}"), Sim::new(fault))).collect()
}

/// Carries out a rollout and checks what holds for each.
fn rolled_out(boards: &[(String, Sim)], plan: RolloutPlan, stop: &Stop) -> RolloutReport {
    rolled_out_until(boards, plan, stop, usize::MAX)
}

/// Same; somebody asks to end at the begin of this step, counted over all boards.
fn rolled_out_until(
    boards: &[(String, Sim)],
    plan: RolloutPlan,
    stop: &Stop,
    ends_at: usize,
) -> RolloutReport {
    let steps = AtomicUsize::new(0);
    let log = Mutex::new(Vec::new());
    let report = roll_out(NEW, boards, plan, stop, &|event| {
        match event {
            RolloutEvent::Step(_, RolloutStep::Inspect) => log.lock().unwrap().push(true),
            RolloutEvent::Ended(_) => log.lock().unwrap().push(false),
            RolloutEvent::Step(..) | RolloutEvent::Batch(_) => {}
        }
        if matches!(event, RolloutEvent::Step(..)) && steps.fetch_add(1, SeqCst) + 1 == ends_at {
            stop.ask();
        }
    });
    // No board begins before the batch before it has ended.
    let (mut begun, mut ended) = (0, 0);
    for is_begin in log.into_inner().unwrap() {
        if is_begin {
            assert_eq!(ended / plan.batch, begun / plan.batch, "{begun} begun, {ended} ended");
            begun += 1;
        } else {
            ended += 1;
        }
    }
    assert_eq!(begun, ended, "a board in hand is brought to its end");
    let not_begun = report.entries.iter().filter(|entry| entry.outcome == BoardOutcome::NotBegun).count();
    assert_eq!(begun, boards.len() - not_begun);
    assert_eq!(report.entries.len(), boards.len());
    for (entry, (name, board)) in report.entries.iter().zip(boards) {
        assert_eq!(entry.name, *name);
        let runs = board.runs();
        match &entry.outcome {
            BoardOutcome::NotBegun => assert_eq!((board.pushes(), board.time()), (0, Duration::ZERO)),
            BoardOutcome::Already | BoardOutcome::Updated => assert_eq!(runs, (NEW, false), "{entry:?}"),
            BoardOutcome::Failed { left: Left::Before, .. } => assert_eq!(runs, (OLD, false), "{entry:?}"),
            BoardOutcome::Failed { left: Left::OnTrial, .. } => assert_eq!(runs, (NEW, true), "{entry:?}"),
            BoardOutcome::Failed { left: Left::New, .. } => assert_eq!(runs, (NEW, false), "{entry:?}"),
            BoardOutcome::Failed { left: Left::Unknown, .. } => {}
        }
        // Each board has its end while its trial lasts.
        assert!(board.time() < Duration::from_secs(60) + TRIAL, "{entry:?}");
    }
    report
}

#[test]
fn each_fault_has_its_words_and_leaves_a_known_firmware() {
    let boards = plant(FAULTS);
    let report = rolled_out(&boards, PLAN, &Stop::new());
    insta::assert_snapshot!("table", format!("{}{}\n", report.table(WIDE), report.summary()));
    insta::assert_snapshot!("document", format!("{:#}", report.document()));
    assert_eq!(report.verdict(), Err(Failure::refused(report.summary())));
}

#[test]
fn a_plant_of_healthy_boards_is_updated_and_the_second_run_does_nothing() {
    for count in [1, 10, 100] {
        let boards = plant(vec![Fault::None; count]);
        for outcome in [BoardOutcome::Updated, BoardOutcome::Already] {
            let report = rolled_out(&boards, PLAN, &Stop::new());
            assert!(report.entries.iter().all(|entry| entry.outcome == outcome), "{report:?}");
            assert_eq!(report.verdict(), Ok(Verdict::Well));
        }
        assert!(boards.iter().all(|(_, board)| board.pushes() == 1));
    }
}

#[test]
fn a_failure_at_any_step_stops_what_follows_and_a_rerun_goes_on() {
    let plan = RolloutPlan { batch: 10, stop_on_failure: true, ..PLAN };
    for fault in FAULTS {
        let mut boards = plant((0..100).map(|nth| if nth == 37 { fault } else { Fault::None }));
        let report = rolled_out(&boards, plan, &Stop::new());
        let is_failure = report.failed().next().is_some();
        let begun = report.entries.iter().filter(|entry| entry.outcome != BoardOutcome::NotBegun).count();
        assert_eq!(begun, if is_failure { 40 } else { 100 }, "{fault:?}: {}", report.summary());
        boards[37].1.mend();
        let before: Vec<_> = boards.iter().map(|(_, board)| board.pushes()).collect();
        let report = rolled_out_again(&boards, plan);
        assert_eq!(report.verdict(), Ok(Verdict::Well), "{fault:?}");
        // Nothing is sent twice but to the board that has failed.
        for (nth, (_, board)) in boards.iter().enumerate().filter(|(nth, _)| *nth != 37) {
            assert_eq!(board.pushes(), 1, "{fault:?}: {nth}, {} before", before[nth]);
        }
    }
}

/// Boards that have been through a rollout before have their time behind them.
fn rolled_out_again(boards: &[(String, Sim)], plan: RolloutPlan) -> RolloutReport {
    roll_out(NEW, boards, plan, &Stop::new(), &|_| {})
}

#[test]
fn whatever_fails_anywhere_each_board_ends_on_one_whole_firmware() {
    let mut seed = 0x2545_F491_4F6C_DD1D_u64;
    let mut random = |below: usize| {
        seed ^= seed << 13;
        seed ^= seed >> 7;
        seed ^= seed << 17;
        (seed >> 33) as usize % below
    };
    for _ in 0..60 {
        let faults: Vec<_> = (0..100)
            .map(|_| if random(4) == 0 { FAULTS[random(FAULTS.len())] } else { Fault::None })
            .collect();
        let plan = RolloutPlan { batch: 1 + random(25), stop_on_failure: random(3) == 0, ..PLAN };
        let mut boards = plant(faults);
        let ends_at = if random(2) == 0 { 1 + random(400) } else { usize::MAX };
        let report = rolled_out_until(&boards, plan, &Stop::new(), ends_at);
        assert_eq!(report.document()["gateways"].as_array().unwrap().len(), 100);
        boards.iter_mut().for_each(|(_, board)| board.mend());
        assert_eq!(rolled_out_again(&boards, plan).verdict(), Ok(Verdict::Well));
        assert!(boards.iter().all(|(_, board)| board.runs() == (NEW, false)));
    }
}

#[test]
fn who_asks_to_end_waits_for_the_boards_in_hand_and_is_told_where_to_go_on() {
    for ends_at in 1..=30 {
        let plan = RolloutPlan { batch: 3, ..PLAN };
        let boards = plant([Fault::None; 10]);
        let report = rolled_out_until(&boards, plan, &Stop::new(), ends_at);
        let updated = report.entries.iter().filter(|entry| entry.outcome == BoardOutcome::Updated).count();
        assert_eq!(report.failed().count(), 0);
        assert!(report.was_stopped && updated < 10, "{}", report.summary());
        let next = report.entries.iter().find(|entry| entry.outcome == BoardOutcome::NotBegun).unwrap();
        assert!(report.summary().contains(&format!("from {} on; the same command", next.name)));
        assert_eq!(rolled_out_again(&boards, plan).verdict(), Ok(Verdict::Well));
        assert!(boards.iter().all(|(_, board)| board.pushes() == 1));
    }
}

#[test]
fn who_asks_to_end_does_not_wait_for_a_large_batch() {
    let boards = plant([Fault::None; 100]);
    let report = rolled_out_until(&boards, RolloutPlan { batch: 100, ..PLAN }, &Stop::new(), 1);
    let begun = report.entries.iter().filter(|entry| entry.outcome != BoardOutcome::NotBegun).count();
    assert!((1..=MAX_AT_ONCE).contains(&begun), "{begun}");
}

#[test]
fn a_trial_that_a_rollout_before_has_left_is_brought_to_its_end() {
    for (fault, good) in [(Fault::None, true), (Fault::SlowLinks, true), (Fault::Worse, false)] {
        let boards = plant([fault]);
        let (_, board) = &boards[0];
        board.push().unwrap();
        board.begin().unwrap();
        let report = rolled_out_again(&boards, PLAN);
        assert_eq!(report.entries[0].outcome == BoardOutcome::Updated, good, "{report:?}");
        assert_eq!(board.runs(), if good { (NEW, false) } else { (OLD, false) });
        assert_eq!(board.pushes(), 1);
    }
}

#[test]
fn the_trial_of_another_firmware_is_left_alone() {
    let boards = plant([Fault::None]);
    boards[0].1.inside.lock().unwrap().trial = Some((Duration::ZERO, "0.2.9"));
    let report = rolled_out_again(&boards, PLAN);
    let BoardOutcome::Failed { step: RolloutStep::Inspect, why, .. } = &report.entries[0].outcome else {
        panic!("{report:?}")
    };
    assert_eq!(why, "another firmware is on trial; confirm it or take it back first");
    assert_eq!(boards[0].1.runs(), ("0.2.9", true));
}
