"""The table of services: two machines understand each other only while names and ports stay."""

from __future__ import annotations

from splatnode.capture.messaging import network
from splatnode.capture.messaging.network import Service


def test_names_and_ports_stay():
    table = [value for value in vars(network).values() if isinstance(value, Service)]
    assert {service.name: service.tcp_port for service in table} == {
        "capture.keyframes": 0,
        "capture.preview": 1,
        "capture.status": 2,
        "recon.scene": 3,
        "recon.status": 5,
        "recon.control": 6,
        "capture.control": 7,
        "recon.map": 8,
        "recon.depth": 10,
        "recon.locate": 12,
    }
    assert network.RECON_SCENE.requests == Service("recon.scene.requests", network.Pattern.STATE, 4)
