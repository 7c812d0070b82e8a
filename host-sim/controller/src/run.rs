//! Effects of time: transitions, the program's calls, cycles and the state stream.

use proto_core::command::Action;
use proto_core::time::{Duration, Instant};
use proto_core::wire::dialect::{FinishNotice, Motion};

use super::common::Link;
use super::events::Happened;
use super::machine::{Effect, ErrorId, Transition};
use super::motion::Braking;
use super::ports::{Handed, Listening, PortData};
use super::program::{Call, CallReply, End, Program, Progress, Script, Variables, shortened};
use super::registers::MachineCodes;
use super::{ConnId, Controller, ControllerOutput, MAX_LOG};

#[derive(Debug)]
pub(super) struct RunningProgram {
    program: Program,
    activity: Activity,
    started_by: Option<ConnId>,
}

/// The state of the program's pending call.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Activity {
    /// The call takes no time or has not been handled yet.
    None,
    Waiting {
        until: Instant,
    },
    /// A wait interrupted by a pause.
    Held {
        left: Duration,
    },
    Moving,
    Sending {
        port: usize,
    },
    /// Waiting for the next slice.
    GivingWay {
        until: Instant,
    },
}

impl RunningProgram {
    pub(super) fn name(&self) -> &str {
        self.program.name()
    }

    pub(super) fn variables(&self) -> Variables {
        self.program.variables()
    }
}

impl Controller {
    /// Advances everything to `now`.
    pub(super) fn advance(&mut self, now: Instant) {
        while let Some(effect) = self.machine.poll(now) {
            self.apply(now, effect);
            self.settle(now);
        }
        self.settle(now);
        self.execute_functions(now);
        self.refresh(now);
        if self.running.is_some() {
            self.drive_program(now);
            self.refresh(now);
        }
        self.poll_ports(now);
        self.poll_state_stream(now);
        self.poll_server(now);
    }

    pub(super) fn deadline(&self) -> Instant {
        let program = self.running.as_ref().filter(|_| self.machine.program_runs()).and_then(|running| {
            match running.activity {
                Activity::Waiting { until } | Activity::GivingWay { until } => Some(until),
                Activity::Moving => self.arm.arrival(),
                Activity::None | Activity::Held { .. } | Activity::Sending { .. } => None,
            }
        });
        let state = self.server.has_subscribers().then(|| self.state_grid.next());
        let ports = self.ports.iter().filter_map(|port| port.deadline()).min();
        let all = [self.machine.deadline(), program, state, ports, self.server.deadline()];
        all.into_iter().flatten().min().unwrap_or(Instant::NEVER)
    }

    /// Executes a command, button or input on the machine and applies its effect on the rest of the controller.
    ///
    /// # Errors
    /// The error that the machine shows; nothing else has changed.
    pub(super) fn act(&mut self, now: Instant, action: Action) -> Result<Transition, ErrorId> {
        let (effect, transition) = self.machine.act(now, action)?;
        self.runs.ends_by(cause_of(action));
        self.apply(now, effect);
        Ok(transition)
    }

    pub(super) fn apply(&mut self, now: Instant, effect: Effect) {
        match effect {
            Effect::None => {}
            Effect::Hold => {
                self.slow_down(now, Braking::Normal);
                if let Some(running) = &mut self.running
                    && let Activity::Waiting { until } = running.activity
                {
                    running.activity = Activity::Held { left: until.saturating_since(now) };
                }
            }
            Effect::Continue => {
                self.arm.set_rate(now, self.machine.rate(), Braking::Normal);
                if let Some(running) = &mut self.running
                    && let Activity::Held { left } = running.activity
                {
                    running.activity = Activity::Waiting { until: now + left };
                }
            }
            Effect::Abort(braking) => {
                if let Some(running) = &mut self.running {
                    running.program.answer(now, CallReply::Abort);
                    running.activity = Activity::None;
                }
                self.slow_down(now, braking);
            }
            Effect::ProgramEnded => {
                self.arm.settle(now);
                self.arm_shown = None;
                self.program_is_over(now, None);
            }
            Effect::ShutDown => {
                self.close_all_clients();
                if let Some(running) = self.running.take() {
                    self.runs.ends_by("shutdown");
                    self.run_over(now, running.name(), None);
                }
                self.outputs.push_back(ControllerOutput::Shutdown);
                self.is_shut_down = true;
            }
        }
    }

    /// Starts the script; its first calls are handled in the next [`Self::advance`].
    pub(super) fn start_program(
        &mut self,
        now: Instant,
        script: &Script,
        started_by: Option<ConnId>,
        by: &'static str,
    ) -> Result<(), ErrorId> {
        for port in &mut self.ports {
            port.forget_received();
        }
        match Program::start_with(script, &self.scripts, now) {
            Ok(program) => {
                self.running = Some(RunningProgram { program, activity: Activity::None, started_by });
                self.machine.program_started();
                self.counters.programs_started += 1;
                let run = self.runs.begin(self.time_s(now));
                let program = || script.name().to_owned();
                self.happened(now, || Happened::ProgramStarted { run, program: program(), by });
                Ok(())
            }
            Err(error) => {
                let message = format!("{}: cannot start a thread for the program: {error}", script.name());
                self.machine.fail(ErrorId::ProgramFailed, message);
                Err(ErrorId::ProgramFailed)
            }
        }
    }

    /// Applies the present speed to the arm, if the program runs.
    pub(super) fn speed_changed(&mut self, now: Instant) {
        if self.machine.program_runs() {
            self.arm.set_rate(now, self.machine.rate(), Braking::Normal);
        }
    }

    /// Whether frames for a program are kept.
    pub(super) fn listening(&self) -> Listening {
        if self.running.is_some() { Listening::Yes } else { Listening::No }
    }

    fn slow_down(&mut self, now: Instant, braking: Braking) {
        self.arm.set_rate(now, 0.0, braking);
        self.machine.arm_rests_at(self.arm.rest().unwrap_or(now));
    }

    /// Writes the state of the arm and the state machines to the registers.
    fn refresh(&mut self, now: Instant) {
        let machine = &self.machine;
        self.registers.show_status(MachineCodes {
            mode: machine.mode().code(),
            mode_register: self.dialect.mode_to_register(machine.mode(), Motion::Real),
            robot: self.dialect.robot_code(machine.robot()),
            program: machine.program().code(),
            safety: self.dialect.safety_code(machine.safety()),
            collision_axis: machine.collision_axis(),
            error: machine.robot_error().map_or(0, ErrorId::code),
            // At most 100.
            speed_percent: machine.speed_percent().round() as u8,
            drives_on: machine.drives_on(),
        });
        self.show_states();
        if now >= self.next_arm_state() {
            let tool = self.registers.tool();
            let actual = self.arm.observe(now, &tool, self.registers.payload_kg());
            // The simulated servo drives follow without lag.
            self.registers.show_arm(actual, actual);
            self.arm_shown = Some(now);
        }
    }

    /// When the registers show another state of the arm: in the next cycle of the drives, or at rest.
    pub(super) fn next_arm_state(&self) -> Instant {
        let Some(shown) = self.arm_shown else { return Instant::ZERO };
        match self.arm.rest() {
            Some(rest) if rest <= shown => Instant::NEVER,
            rest => rest.unwrap_or(Instant::NEVER).min(shown + SERVO_CYCLE),
        }
    }

    /// Answers the program's calls as far as possible.
    fn drive_program(&mut self, now: Instant) {
        while self.machine.program_runs() {
            let Some(running) = &self.running else { return };
            match running.program.progress().clone() {
                Progress::Calling(call) => {
                    let Some(answer) = self.serve(now, &call) else { return };
                    if let Some(running) = &mut self.running {
                        running.activity = Activity::None;
                        running.program.answer(now, answer);
                    }
                }
                Progress::Ended(end) => {
                    if let End::Failed(message) = &end {
                        self.counters.programs_failed += 1;
                        let message = format!("{}: {message}", shortened(running.name(), MAX_NAME));
                        self.machine.fail(ErrorId::ProgramFailed, message);
                    }
                    self.machine.program_ended();
                    self.program_is_over(now, Some(&end));
                    self.settle(now);
                    return;
                }
            }
        }
    }

    fn program_is_over(&mut self, now: Instant, end: Option<&End>) {
        let Some(running) = self.running.take() else { return };
        self.run_over(now, running.name(), end);
        self.variables = running.variables();
        for port in &mut self.ports {
            port.forget_received();
        }
        if self.dialect.finish_notice == FinishNotice::ScriptFinish
            && let Some(conn) = running.started_by
        {
            self.send_finish_notice(now, conn);
        }
    }

    /// The reply to a call; `None` if it is not done yet.
    fn serve(&mut self, now: Instant, call: &Call) -> Option<CallReply> {
        let activity = self.running.as_ref().map_or(Activity::None, |running| running.activity);
        match call {
            Call::Receive { port, limit } => {
                let port = match self.port_named(port) {
                    Ok(nth) => self.ports.get_mut(nth)?,
                    Err(message) => return Some(CallReply::Error(message)),
                };
                if let Err(message) = port.check_receive() {
                    return Some(CallReply::Error(message));
                }
                match (port.next_received(), limit) {
                    (Some(frame), _) => Some(CallReply::Frame { id: frame.id, values: frame.values }),
                    (None, Some(limit)) => self.wait(now, activity, *limit),
                    (None, None) => None,
                }
            }
            Call::Send { port, id, values } => {
                if let Activity::Sending { port } = activity {
                    let port = self.ports.get(port)?;
                    // A port that goes down drops its frame.
                    return (!port.is_busy()).then(|| CallReply::Bit(port.is_up()));
                }
                let nth = match self.port_named(port) {
                    Ok(nth) => nth,
                    Err(message) => return Some(CallReply::Error(message)),
                };
                let port = self.ports.get_mut(nth)?;
                if port.is_busy() {
                    // A frame of an earlier program is still being sent.
                    return None;
                }
                match port.send(*id, values) {
                    Ok(Handed::Over) => self.begin_activity(Activity::Sending { port: nth }),
                    Ok(Handed::NotReady) => Some(CallReply::Bit(false)),
                    Err(message) => Some(CallReply::Error(message)),
                }
            }
            Call::Get { name } => Some(self.read_item(name).unwrap_or_else(CallReply::Error)),
            Call::Set { name, value } => Some(match name.parse() {
                Ok(target) => {
                    let before = self.recorder.before(&self.registers);
                    let result = self.registers.set_by_program(target, *value);
                    self.note_writes(now, before, "program");
                    match result {
                        Ok(()) => CallReply::Done,
                        Err(error) => CallReply::Error(error.to_string()),
                    }
                }
                Err(error) => CallReply::Error(format!("{name}: {error}")),
            }),
            Call::MoveJ { .. } | Call::MoveL { .. } => {
                if activity != Activity::Moving {
                    if let Err(message) = self.start_move(now, call) {
                        return Some(CallReply::Error(message));
                    }
                    self.begin_activity(Activity::Moving);
                }
                if self.arm.arrival().is_none_or(|arrival| now < arrival) {
                    return None;
                }
                self.refresh(now);
                self.arm.settle(now);
                Some(CallReply::Done)
            }
            Call::Wait(time) => self.wait(now, activity, *time),
            Call::GiveWay { until } => {
                if now >= *until {
                    Some(CallReply::Done)
                } else {
                    self.begin_activity(Activity::GivingWay { until: *until })
                }
            }
            Call::Log(line) => {
                tracing::info!(target: "program", "{line}");
                let program = self.program_name().unwrap_or_default().to_owned();
                self.happened(now, || Happened::Log { program, text: line.clone() });
                if self.log.len() >= MAX_LOG {
                    self.log.pop_front();
                }
                self.log.push_back(line.clone());
                Some(CallReply::Done)
            }
        }
    }

    /// Waits for this time from when the call was first handled.
    fn wait(&mut self, now: Instant, activity: Activity, time: Duration) -> Option<CallReply> {
        let until = match activity {
            Activity::Waiting { until } => until,
            _ => now + time,
        };
        if now >= until { Some(CallReply::Done) } else { self.begin_activity(Activity::Waiting { until }) }
    }

    fn start_move(&mut self, now: Instant, call: &Call) -> Result<(), String> {
        let rate = self.machine.rate();
        let (function, started) = match *call {
            Call::MoveJ { target, speed_rad_s } => {
                ("movej", self.arm.move_to(now, target, speed_rad_s, rate))
            }
            Call::MoveL { pose, speed_m_s } => {
                ("movel", self.arm.move_along(now, pose, speed_m_s, &self.registers.tool(), rate))
            }
            _ => return Ok(()),
        };
        started.map_err(|error| format!("{function}: {error}"))
    }

    /// Records what the call waits for; returns no reply.
    fn begin_activity(&mut self, activity: Activity) -> Option<CallReply> {
        if let Some(running) = &mut self.running {
            running.activity = activity;
        }
        None
    }

    pub(super) fn port_named(&self, name: &str) -> Result<usize, String> {
        self.ports.iter().position(|port| port.name() == name).ok_or_else(|| {
            let names: Vec<_> = self.ports.iter().map(|port| port.name()).collect();
            format!("there is no port {name}; there are {}", names.join(", "))
        })
    }

    fn poll_ports(&mut self, now: Instant) {
        let corrupted = self.faults.corrupted().image(self.registers.image());
        let image = corrupted.as_ref().unwrap_or(self.registers.image());
        for (nth, port) in self.ports.iter_mut().enumerate() {
            let outgoing = port.poll(now, image);
            if outgoing.is_empty() {
                continue;
            }
            if self.faults.mutes_port(nth) {
                port.sent();
                continue;
            }
            self.outputs.extend(outgoing.into_iter().map(|outgoing| match outgoing {
                PortData::Bytes(bytes) => ControllerOutput::PortSend { port: nth, bytes },
                PortData::Can(frame) => ControllerOutput::PortSendCan { port: nth, frame },
                PortData::Datagram { peer, bytes } => ControllerOutput::UdpSend { peer, bytes },
            }));
        }
    }

    fn poll_state_stream(&mut self, now: Instant) {
        let Some(missed) = self.state_grid.due(now) else { return };
        if !self.server.has_subscribers() {
            return;
        }
        self.counters.missed_state_packets += missed;
        let mut bytes = self.registers.packet(self.dialect.global_speed);
        self.faults.corrupted().put_in_packet(&mut bytes);
        self.faults.freeze_packet(&mut bytes);
        self.faults.corrupt_bytes(Link::State, &mut bytes[..]);
        if self.faults.mutes(Link::State) {
            self.counters.state.muted += 1;
            return;
        }
        self.counters.state.requests += 1;
        self.counters.state.bytes_out += bytes.len() as u64;
        match self.faults.take_state_cut() {
            Some(at) => self.send_cut_packet(bytes.get(..at).unwrap_or(&bytes[..])),
            None => self.outputs.push_back(ControllerOutput::StatePacket { bytes }),
        }
    }
}

/// The reason shown in `last_run` for a program that an action ends.
fn cause_of(action: Action) -> &'static str {
    match action {
        Action::Disable => "disable",
        Action::PowerOff => "power_off",
        Action::Shutdown => "shutdown",
        _ => "stop",
    }
}

/// Maximum length of a program's name in its error, in bytes.
const MAX_NAME: usize = 64;
/// Interval at which the arm's state is updated.
const SERVO_CYCLE: Duration = Duration::from_millis(1);
