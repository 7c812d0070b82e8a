"""The fixtures, as a project of its own uses them."""

import pytest

pytest_plugins = ["pytester"]


@pytest.fixture
def project(pytester):
    pytester.makeini("[pytest]\naddopts = -p no:cacheprovider --strict-markers\n")
    return pytester


def test_a_failure_is_reported_with_state_events_and_log(project):
    project.makepyfile(
        """
        import pytest

        @pytest.mark.duco(time="stepped")
        @pytest.mark.parametrize("nth", range(2))
        def test_it(duco_controller, nth):
            duco_controller.di[7] = True
            duco_controller.run("pick.jspf")
            duco_controller.advance(3)
            assert nth == 1

        def test_gateway(recipe_gateway):
            recipe_gateway.wait_up()
            assert False
        """
    )
    result = project.runpytest_subprocess("-n", "2")
    result.assert_outcomes(passed=1, failed=2)
    text = result.stdout.str()
    for wanted in (
        "duco_sim: controller: state",
        "duco_sim: controller: newest events",
        "duco_sim: controller: log of host-sim",
        "duco_sim: gateway: counters",
        "outcome='failed'",
        "DI[7]",
    ):
        assert wanted in text, wanted


def test_markers(project):
    project.makepyfile(
        """
        import pytest

        pytestmark = pytest.mark.duco(time="stepped", set={"robot.power": "off"})

        @pytest.mark.duco(config="[robot]\\nmode = 'auto'\\n")
        def test_nearer_ones_override(duco_controller):
            assert (duco_controller.time, duco_controller.power, duco_controller.mode) == ("stepped", "off", "auto")

        def test_factory(duco_controller_factory):
            robots = [duco_controller_factory(seed=seed) for seed in range(3)]
            assert len({robot.command_address for robot in robots}) == 3
            assert all(robot.time == "stepped" for robot in robots)

        @pytest.mark.duco("stepped")
        def test_wrong(duco_controller):
            pass
        """
    )
    result = project.runpytest_subprocess()
    result.assert_outcomes(passed=2, errors=1)
    result.stdout.fnmatch_lines(["*takes arguments by name only*"])


def test_a_controller_that_fails_makes_the_test_fail(project):
    project.makepyfile(
        """
        import os, signal

        def test_it(duco_controller):
            os.kill(duco_controller.pid, signal.SIGKILL)
        """
    )
    result = project.runpytest_subprocess()
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines(["*SIGKILL*"])
