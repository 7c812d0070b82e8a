"""The gateway, connected to a controller."""

import pytest

import duco_sim


def test_a_device_reaches_the_controller(recipe_gateway, duco_controller):
    recipe_gateway.wait_up()
    with recipe_gateway.port("rs485-1").open(timeout=5) as device:
        for _ in range(3):
            device.write(b"\xff\xff\x05\xee\xee")
        duco_controller.wait(items={"DO[1]": 1, "DO[2]": 0, "DO[3]": 1})
        assert device.read(16)[:2] == b"\xff\xff"
    # Its safe value.
    duco_controller.wait(items={"DO[1]": 0})
    stats = recipe_gateway.stats()
    assert stats["ports"]["rs485-1"]["frames_in"] == 3
    assert "rs485-1" in recipe_gateway.log or recipe_gateway.log


@pytest.mark.recipe_gateway(set={"port.rs485-1.timeout_ms": 50})
def test_a_device_behind_it(recipe_gateway, duco_controller):
    @recipe_gateway.device("rs485-1")
    def station(request):
        return b"\xff\xff\x01\xee\xee"

    station.send(b"\xff\xff\x01\xee\xee")
    duco_controller.wait(items={"DO[1]": 1})
    assert len(station.wait_requests(3)) >= 3


def test_nothing_is_left_behind():
    with duco_sim.Gateway(set={"controller.ports.command": 1}) as gateway:
        folder = gateway.folder
        assert gateway.stats()["ports"]["rs485-1"]["frames_in"] == 0
        with pytest.raises(TimeoutError, match="links|come"):
            gateway.wait(lambda stats: False, timeout=0.1)
    assert not folder.exists()
    with pytest.raises(duco_sim.ProcessError):
        gateway.stats()
    with pytest.raises(duco_sim.ProcessError, match="cycle_ms"):
        duco_sim.Gateway(set={"port.rs485-1.cycle_ms": 1})
