"""Fixtures for pytest, there as soon as the package is installed.

- ``duco_controller``: a running :class:`duco_sim.Controller` for this test alone
- ``duco_controller_factory``: makes as many as the test wants; takes what :class:`duco_sim.Controller` takes
- ``recipe_gateway``: a running :class:`duco_sim.Gateway`, connected to ``duco_controller``

``@pytest.mark.duco(config=..., time="stepped")`` gives the controller's arguments, ``@pytest.mark.recipe_gateway(...)``
the gateway's; of several markers the nearest to the test counts for each argument. A test that fails is reported with
their state, newest events and logs. Every controller has free ports and a folder of its own, so pytest-xdist can run
such tests side by side.
"""

from __future__ import annotations

from typing import Any, Callable, Dict, Generator, Iterator, List, Tuple, Union

import pytest

from .controller import Controller
from .gateway import Gateway

Run = Union[Controller, Gateway]
_RUNS = pytest.StashKey[List[Tuple[str, Run]]]()


def pytest_configure(config: pytest.Config) -> None:
    """Registers the markers."""
    config.addinivalue_line(
        "markers", "duco(**arguments): arguments of duco_sim.Controller for the fixture duco_controller"
    )
    config.addinivalue_line(
        "markers", "recipe_gateway(**arguments): arguments of duco_sim.Gateway for the fixture recipe_gateway"
    )


@pytest.fixture
def duco_controller_factory(request: pytest.FixtureRequest) -> Iterator[Callable[..., Controller]]:
    """Starts controllers, which end with the test: ``duco_controller_factory(time="stepped")``.

    What the markers ``duco`` say counts for each of them, unless it is given here.
    """
    started: List[Controller] = []

    def start(**arguments: Any) -> Controller:
        robot = Controller(**{**_marked(request, "duco"), **arguments})
        started.append(robot)
        _runs(request).append((f"controller {len(started)}" if len(started) > 1 else "controller", robot))
        return robot

    yield start
    _close(started)


@pytest.fixture
def duco_controller(duco_controller_factory: Callable[..., Controller]) -> Controller:
    """A simulated controller, with the arguments that the markers ``duco`` give."""
    return duco_controller_factory()


@pytest.fixture
def recipe_gateway(request: pytest.FixtureRequest, duco_controller: Controller) -> Iterator[Gateway]:
    """A gateway in front of ``duco_controller``, with the arguments that the markers ``recipe_gateway`` give."""
    gateway = Gateway(**{"controller": duco_controller, **_marked(request, "recipe_gateway")})
    _runs(request).append(("gateway", gateway))
    yield gateway
    _close([gateway])


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, Any, None]:
    """Adds to the report of a failed test what its controllers and gateways tell."""
    outcome = yield
    report: pytest.TestReport = outcome.get_result()
    if report.failed and report.when != "teardown":  # they have ended by then
        for name, run in item.stash.get(_RUNS, []):
            report.sections.extend((f"duco_sim: {name}: {title}", text) for title, text in run.report().items() if text)


def _runs(request: pytest.FixtureRequest) -> List[Tuple[str, Run]]:
    runs: List[Tuple[str, Run]] = request.node.stash.setdefault(_RUNS, [])
    return runs


def _marked(request: pytest.FixtureRequest, name: str) -> Dict[str, Any]:
    """The arguments of all markers of this name; a nearer one overrides."""
    arguments: Dict[str, Any] = {}
    for marker in reversed(list(request.node.iter_markers(name))):
        if marker.args:
            raise pytest.UsageError(f"the marker {name} takes arguments by name only")
        arguments.update(marker.kwargs)
    return arguments


def _close(runs: List[Any]) -> None:
    errors: List[Exception] = []
    for run in reversed(runs):
        try:
            run.close()
        except Exception as error:
            errors.append(error)
    if errors:
        raise errors[0]
