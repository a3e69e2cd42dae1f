"""The hub: every client sees the frames of all others, whole and in order."""

from __future__ import annotations

import socket
import threading

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfdropo_bayes.deployment.bench.hub import FRAME, Hub, HubBus, address_of, decode, encode
from rfdropo_bayes.deployment.bus import BusTable, open_bus
from rfdropo_bayes.errors import InputError

frames = st.builds(
    lambda identifier, data, extended: can.Message(
        arbitration_id=identifier if extended else identifier & 0x7FF, data=data, is_extended_id=extended
    ),
    st.integers(0, 0x1FFFFFFF),
    st.binary(max_size=8),
    st.booleans(),
)


@given(frames)
def test_a_frame_survives_the_wire(frame: can.Message) -> None:
    found = decode(encode(frame), 0.0)
    assert found.arbitration_id == frame.arbitration_id
    assert found.is_extended_id == frame.is_extended_id
    assert bytes(found.data) == bytes(frame.data)


def test_remote_frames_keep_their_length() -> None:
    frame = can.Message(arbitration_id=0x701, is_remote_frame=True, dlc=1, is_extended_id=False)
    found = decode(encode(frame), 0.0)
    assert found.is_remote_frame
    assert found.dlc == 1


def test_frames_reach_all_others_in_one_order(hub: str) -> None:
    one, two, three = (HubBus(hub) for _ in range(3))
    for number in range(500):
        sender = one if number % 2 else two
        sender.send(can.Message(arbitration_id=number, data=[number & 0xFF], is_extended_id=False))
        got = three.recv(2.0)
        assert got is not None
        assert got.arbitration_id == number
    assert one.recv(1.0).arbitration_id == 0  # the other's frames, and never its own
    for bus in (one, two, three):
        bus.shutdown()


def test_frames_cut_by_the_transport_are_put_together(hub: str) -> None:
    family, address = address_of(hub)
    raw = socket.socket(family, socket.SOCK_STREAM)
    raw.connect(address)
    bus = HubBus(hub)
    bus.recv(0.05)
    content = FRAME.pack(0x123, 2, b"ab") + FRAME.pack(0x124, 1, b"c")
    for byte in content:
        raw.send(bytes([byte]))
    assert [bus.recv(2.0).arbitration_id for _ in range(2)] == [0x123, 0x124]
    raw.close()
    bus.shutdown()


def test_a_hub_that_has_gone_is_an_error_not_a_silence(tmp_path) -> None:
    server, done = Hub(str(tmp_path / "bus")), threading.Event()
    thread = threading.Thread(target=server.serve, args=(done.is_set,))
    thread.start()
    bus = HubBus(server.channel)
    bus.send(can.Message(arbitration_id=1))
    done.set()
    thread.join()
    with pytest.raises(can.CanOperationError, match="the hub has gone"):
        bus.recv(2.0)
    bus.shutdown()


@pytest.mark.parametrize("channel", ["nowhere", "host:", "host:port", ":80"])
def test_bad_channels_are_refused(channel: str) -> None:
    with pytest.raises(InputError, match="not a channel of a hub"):
        address_of(channel)


def test_a_bus_without_hub_says_so(tmp_path) -> None:
    with pytest.raises(InputError, match="no hub answers"):
        HubBus(str(tmp_path / "nothing"), patience=0.1)


def test_an_interface_that_cannot_be_opened_says_why() -> None:
    with pytest.raises(InputError, match="bus socketcan nocan0"):
        open_bus(BusTable(interface="socketcan", channel="nocan0"))
