"""Who answers on a bus."""

from __future__ import annotations

import threading

import can
import pytest

from rfdropo_bayes.deployment.bench.hub import HubBus
from rfdropo_bayes.deployment.bus import BusTable
from rfdropo_bayes.deployment.doctor import scan


@pytest.mark.parametrize("command", [0x42, 0x43])
def test_a_node_is_found_whether_or_not_its_answers_state_their_size(hub: str, command: int) -> None:
    """CiA 301 leaves it to the drive."""
    bus, done = HubBus(hub), threading.Event()

    def answer() -> None:
        while not done.is_set():
            asked = bus.recv(0.05)
            if asked is not None and asked.arbitration_id == 0x605:
                value = 0x00020192 if asked.data[1:3] == b"\x00\x10" else 0x100 + asked.data[3]
                data = bytes([command, *asked.data[1:4]]) + value.to_bytes(4, "little")
                bus.send(can.Message(arbitration_id=0x585, data=data, is_extended_id=False))

    node = threading.Thread(target=answer, daemon=True)
    node.start()
    try:
        found = scan(BusTable(interface="hub", channel=hub))
    finally:
        done.set()
        node.join()
        bus.shutdown()
    identity = {"vendor": 0x101, "product": 0x102, "revision": 0x103, "serial": 0x104}
    assert found == {"5": {"device_type": 0x00020192} | identity}
