"""What a user of the types writes: mypy --strict finds nothing wrong, and each `type: ignore` is needed."""

from typing import Callable, List, Optional, Union

import duco_sim


def test_uses_types(
    duco_controller: duco_sim.Controller, duco_controller_factory: Callable[..., duco_sim.Controller]
) -> None:
    robot = duco_controller
    robot.di[3] = True
    robot.di[3] = "on"  # type: ignore[assignment]
    on: bool = robot.do[1]
    volts: float = robot.ai_v[2]
    word: int = robot.word_output[1]
    anything: Union[bool, int, float] = robot["RobotState[8]"]
    run: Optional[duco_sim.Run] = robot.last_run
    robot.last_run.outcome  # type: ignore[union-attr]
    with robot.fault("command", delay=0.5) as fault:
        fault.heal()
    robot.fault("command", dealy=0.5)  # type: ignore[call-arg]
    robot.wait(robot="enable", timeout=1)
    robot.wait(robot=6)  # type: ignore[arg-type]
    texts: List[str] = [str(event["text"]) for event in robot.events("command")]

    @robot.device("rs485")
    def scale(request: bytes) -> Optional[bytes]:
        return request

    requests: List[bytes] = scale.requests
    print(on, volts, word, anything, run, texts, requests)
