"""Variables of a real IOC, by both protocols."""

import asyncio
import math

import pytest

from beamfit.errors import InputError
from beamfit.live.channel import LostError, open_channel, run

BOTH = pytest.mark.parametrize("scheme", ["ca", "pva"])


@BOTH
def test_a_variable_is_described_written_and_read(ioc, scheme):
    async def use():
        setting = open_channel(f"{scheme}://SIM:Q2:SET")
        described = await setting.describe()
        await setting.put(1.25)
        return described, await setting.get(), await open_channel("SIM:Q2:TRUE").get()

    described, setting, true = run(use())
    assert described == ("T/m", -8.0, 8.0)
    assert setting.value == 1.25
    assert setting.good
    assert setting.time > 1.7e9
    assert true.value == pytest.approx(1.25)  # completion is when the supply has arrived
    assert ioc.puts("Q2")[-1] == 1.25


@BOTH
def test_a_variable_is_followed_with_its_own_time_stamps(ioc, scheme):
    async def follow():
        readings = []
        async for reading in open_channel(f"{scheme}://SIM:SCREEN:X").monitor():
            readings.append(reading)
            if len(readings) == 5:
                return readings

    readings = run(asyncio.wait_for(follow(), 10))
    times = [reading.time for reading in readings]
    assert sorted(set(times)) == times
    assert all(10 < reading.value < 1000 for reading in readings)


@BOTH
def test_what_does_not_answer_is_named(ioc, scheme):
    with pytest.raises(LostError, match=r"no answer from 'SIM:NONE' within 0.3 s; expected"):
        run(open_channel(f"{scheme}://SIM:NONE", timeout=0.3).get())


def test_a_size_that_is_none_is_no_good_reading(ioc):
    async def use():
        await open_channel("SIM:FAULT:NAN").put(1)
        await asyncio.sleep(0.2)
        found = await open_channel("SIM:SCREEN:X").get()
        await open_channel("SIM:FAULT:NAN").put(0)
        return found

    found = run(use())
    assert math.isnan(found.value)
    assert not found.good


def test_another_protocol_is_refused():
    with pytest.raises(InputError, match="expected a name, ca://NAME or pva://NAME"):
        open_channel("tango://a/b/c")


@pytest.mark.parametrize("name", ["", "pva://", "A\0", "ca://A\x1b[2J"])
def test_a_name_that_none_can_have_is_refused(name):
    with pytest.raises(InputError, match="expected a name of letters that can be shown"):
        open_channel(name)
