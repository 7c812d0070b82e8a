use super::*;

const NOW: Instant = Instant::from_millis(5);

fn start(text: &str) -> Program {
    Program::start(&Script::compile("t", text).unwrap(), NOW).unwrap()
}

/// Runs the script until it needs an answer, in as many slices as it takes.
fn start_slices(text: &str) -> Program {
    let mut program = start(text);
    give_slices(&mut program);
    program
}

/// Continues through its slices to the next call of a function.
fn give_slices(program: &mut Program) {
    while let Progress::Calling(Call::GiveWay { until }) = *program.progress() {
        program.answer(until, CallReply::Done);
    }
}

#[track_caller]
fn call(program: &Program) -> Call {
    match program.progress() {
        Progress::Calling(call) => call.clone(),
        Progress::Ended(end) => panic!("the program has ended: {end:?}"),
    }
}

#[track_caller]
fn failure(program: &Program) -> String {
    match program.progress() {
        Progress::Ended(End::Failed(message)) => message.clone(),
        other => panic!("{other:?}"),
    }
}

#[test]
fn each_call_waits_for_its_answer() {
    let mut program = start(
        r#"
        let list1 = comm_recv("rs485");
        comm_send("rs485", [125, 125.0, true]);
        comm_send("can", 2, list1);
        set("WordOutputReg[1]", get("RobotState[8]"));
        movej([0, 0.5, 0, 0, 0, 0], 1);
        wait_ms(1.5);
        log(`${get("DI[1]")}`);
        "#,
    );
    assert_eq!(call(&program), Call::Receive { port: "rs485".to_owned(), limit: None });
    assert!(program.variables().is_empty());
    let values = vec![Scalar::Byte(1), Scalar::Char(-2), Scalar::Float(0.5)];
    program.answer(NOW, CallReply::Frame { id: None, values });
    let sent = Call::Send { port: "rs485".to_owned(), id: None, values: vec![125.0, 125.0, 1.0] };
    assert_eq!(call(&program), sent);
    assert_eq!(serde_json::to_string(&program.variables()).unwrap(), r#"{"list1":[1,-2,0.5]}"#);
    program.answer(NOW, CallReply::Done);
    let sent = Call::Send { port: "can".to_owned(), id: Some(2), values: vec![1.0, -2.0, 0.5] };
    assert_eq!(call(&program), sent);
    program.answer(NOW, CallReply::Done);
    assert_eq!(call(&program), Call::Get { name: "RobotState[8]".to_owned() });
    program.answer(NOW, CallReply::Value(Scalar::Word(7)));
    assert_eq!(call(&program), Call::Set { name: "WordOutputReg[1]".to_owned(), value: 7.0 });
    program.answer(NOW, CallReply::Done);
    let target = [0.0, 0.5, 0.0, 0.0, 0.0, 0.0];
    assert_eq!(call(&program), Call::MoveJ { target, speed_rad_s: 1.0 });
    program.answer(NOW, CallReply::Done);
    assert_eq!(call(&program), Call::Wait(Duration::from_micros(1_500)));
    program.answer(NOW, CallReply::Done);
    assert_eq!(call(&program), Call::Get { name: "DI[1]".to_owned() });
    program.answer(NOW, CallReply::Bit(true));
    assert_eq!(call(&program), Call::Log("true".to_owned()));
    program.answer(NOW, CallReply::Done);
    assert_eq!(program.progress(), &Progress::Ended(End::Finished));
    program.answer(NOW, CallReply::Done);
}

#[test]
fn a_received_can_frame_begins_with_its_id() {
    let mut program = start(r#"let list1 = comm_recv("can");"#);
    let values = vec![Scalar::Byte(1), Scalar::Byte(2), Scalar::Byte(3)];
    program.answer(NOW, CallReply::Frame { id: Some(CanId::Standard(1)), values });
    assert_eq!(program.progress(), &Progress::Ended(End::Finished));
    assert_eq!(serde_json::to_string(&program.variables()).unwrap(), r#"{"list1":[1,1,2,3]}"#);
}

#[test]
fn variables_are_published_while_a_loop_never_reads_them() {
    let mut program = start(r#"loop { let list1 = comm_recv("a"); comm_send("a", [125]); }"#);
    for nth in 0..3 {
        program.answer(NOW, CallReply::Frame { id: None, values: vec![Scalar::Byte(nth)] });
        assert!(matches!(call(&program), Call::Send { .. }));
        assert_eq!(program.variables()["list1"], serde_json::json!([nth]));
        program.answer(NOW, CallReply::Done);
    }
}

#[test]
fn variables_changed_before_a_call_are_published_during_it() {
    let mut program =
        start("let n = [1]; let s = #{ a: \"x\", b: () }; n[0] = 9; wait_ms(1); n += 2; wait_ms(1);");
    assert_eq!(program.variables()["n"], serde_json::json!([9]));
    assert_eq!(program.variables()["s"], serde_json::json!({ "a": "x", "b": null }));
    program.answer(NOW, CallReply::Done);
    assert_eq!(program.variables()["n"], serde_json::json!([9, 2]));
}

#[test]
fn a_script_that_does_not_wait_is_cut_in_slices() {
    let at = |millis| Instant::from_millis(millis);
    let mut program = start("let n = 0; loop { n += 1; }");
    for slice in 0..10 {
        assert_eq!(call(&program), Call::GiveWay { until: at(6 + slice) });
        program.answer(at(6 + slice), CallReply::Done);
    }
    // After a late slice the next one has its full length.
    program.answer(at(100), CallReply::Done);
    assert_eq!(call(&program), Call::GiveWay { until: at(101) });
    program.answer(at(101), CallReply::Abort);
    assert_eq!(program.progress(), &Progress::Ended(End::Aborted));

    // Calls count too; a call that takes time begins a new slice.
    let mut program = start("loop { wait_ms(0); }");
    let mut calls = 0;
    while call(&program) == Call::Wait(Duration::ZERO) {
        calls += 1;
        program.answer(NOW, CallReply::Done);
    }
    assert_eq!((calls, call(&program)), (9, Call::GiveWay { until: at(6) }));
    let mut program = start("loop { for i in 0..50 { let x = i; } wait_ms(1); }");
    for nth in 0..1_000 {
        assert_eq!(call(&program), Call::Wait(Duration::from_millis(1)), "{nth}");
        program.answer(at(6 + nth), CallReply::Done);
    }
}

#[test]
fn a_script_gets_as_far_in_a_slice_in_every_run() {
    let text = "let n = 0; let a = []; loop { n += 1; a.push([n, n]); if n % 97 == 0 { log(n); } \
                if a.len() > 300 { a = []; } if n % 10 == 0 { let b = [n, 1].filter(|x| x > 1); } }";
    let run = || {
        let mut program = start(text);
        let mut now = NOW;
        let mut steps = Vec::new();
        for _ in 0..2_000 {
            steps.push((now, call(&program)));
            if let Call::GiveWay { until } = call(&program) {
                now = until;
            }
            program.answer(now, CallReply::Done);
        }
        (steps, program.variables())
    };
    let first = run();
    assert_eq!(first, run());
    let slices = first.0.iter().filter(|step| matches!(step.1, Call::GiveWay { .. })).count();
    assert!(slices > 1_000 && slices < 2_000, "{slices}");
}

#[test]
fn a_script_that_copies_much_does_less_in_a_slice() {
    let copies = |items: usize| {
        let text = format!(
            "let a = []; for i in 0..{items} {{ a.push(i); }} let n = 0; log(0); \
             loop {{ let b = a; n += 1; if n == 2000 {{ log(n); }} }}"
        );
        let mut program = start_slices(&text);
        let mut slices = 0;
        program.answer(Instant::from_millis(60_000), CallReply::Done);
        while let Progress::Calling(Call::GiveWay { until }) = *program.progress() {
            slices += 1;
            program.answer(until, CallReply::Done);
        }
        assert_eq!(call(&program), Call::Log("2000".to_owned()));
        slices
    };
    let (few, many) = (copies(0), copies(1_000));
    assert!(many > 20 * few, "{few} and {many} slices");
}

#[test]
fn memory_is_bounded() {
    for (text, word) in [
        ("let a = []; loop { a.push(1); }", "Size of array"),
        ("let a = \"x\"; loop { a += a; }", "Length of string"),
        (
            "let b = []; for i in 0..500 { b.push(i); } let a = #{ }; for i in 0..900 { a[`${i}`] = b; }",
            "items in the variables",
        ),
        ("fn f(x) { f(x + 1) } f(0);", "Stack overflow"),
        ("let a = [[]]; for i in 0..100 { a.push(a); }", "Size of array"),
    ] {
        let program = start_slices(text);
        assert!(
            matches!(program.progress(), Progress::Ended(End::Failed(_))),
            "{text}: {:?}",
            program.progress()
        );
        let message = failure(&program);
        assert!(message.contains(word), "{text}: {message}");
    }
}

#[test]
fn errors_name_their_line_and_can_be_caught() {
    let message = failure(&start("let x = 1;\nlet y = x / 0;"));
    assert!(message.contains("line 2"), "{message}");
    assert!(failure(&start("wait_ms(-1);")).contains("wait_ms takes 0"), "negative wait");
    assert!(failure(&start("movej([1, 2], 1);")).contains("6 joint positions"), "short target");
    assert!(failure(&start("comm_send(\"a\", [\"x\"]);")).contains("a number is needed"), "string value");
    assert!(failure(&start("sleep(1);")).contains("wait_ms"), "sleep");
    assert!(failure(&start("timestamp();")).contains("no clock"), "timestamp");

    let mut program = start("try { comm_send(\"a\", [1]); } catch (e) { log(e); }");
    program.answer(NOW, CallReply::Error("no such port".to_owned()));
    assert_eq!(call(&program), Call::Log("no such port".to_owned()));

    let broken = Script::compile("t", "let a = ;\n").unwrap_err();
    assert_eq!(broken.line(), Some(1));
    assert!(Script::compile("t", "eval(\"1\")").is_err());
}

#[test]
fn an_abort_cannot_be_caught() {
    let mut program = start("loop { try { wait_ms(10); } catch { log(\"caught\"); } }");
    program.answer(NOW, CallReply::Abort);
    assert_eq!(program.progress(), &Progress::Ended(End::Aborted));
}

#[test]
fn an_abort_during_a_print_ends_the_script_too() {
    let mut program = start("loop { print(\"x\"); }");
    assert_eq!(call(&program), Call::Log("x".to_owned()));
    program.answer(NOW, CallReply::Abort);
    assert_eq!(program.progress(), &Progress::Ended(End::Aborted));
    drop(start("loop { print(\"x\"); }"));
}

#[test]
fn a_dropped_program_leaves_no_thread() {
    let program = start("loop { try { wait_ms(10); } catch { } }");
    // It joins the thread: one that does not end would hang the test.
    drop(program);
}
