"""``python -m sim.vehicle --flavour px4 --udp 127.0.0.1:14550``: a vehicle until Ctrl-C."""

from __future__ import annotations

import argparse
import contextlib

from calib.frames import LocalFrame
from sim.vehicle import Faults, VehicleOptions, VehicleServer


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise argparse.ArgumentTypeError(f"{text!r} is not host:port")
    return host, int(port)


def _home(text: str) -> LocalFrame:
    try:
        latitude, longitude, altitude = (float(part) for part in text.split(","))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not latitude,longitude,altitude") from error
    return LocalFrame(latitude, longitude, altitude)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser("python -m sim.vehicle", description="A simulated MAVLink vehicle.")
    parser.add_argument("--flavour", choices=["ardupilot", "px4"], default="ardupilot")
    parser.add_argument("--udp", type=_address, default=("127.0.0.1", 14550), metavar="HOST:PORT")
    parser.add_argument("--home", type=_home, default=VehicleOptions().home, metavar="LAT,LON,ALT")
    parser.add_argument("--speed-up", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--drop", type=float, default=0.0, help="share of messages lost")
    parser.add_argument("--repeat", type=float, default=0.0, help="share of messages sent twice")
    parser.add_argument("--delay", type=float, default=0.0, help="seconds")
    parser.add_argument("--jitter", type=float, default=0.0, help="seconds either way")
    parser.add_argument("--reject-item", type=int, help="item of an upload that is refused")
    parser.add_argument("--cut-at-item", type=int, help="item of an upload at which the link dies for 10 s")
    parser.add_argument("--miss-photos", type=float, default=0.0, help="share of triggers without a photo")
    parser.add_argument("--camera-component", action="store_true", help="a camera that confirms photos")
    parser.add_argument("--feedback-pin", action="store_true", help="photos told in boot time (ArduPilot)")
    got = parser.parse_args(arguments)
    options = VehicleOptions(
        got.flavour, got.home, camera_component=got.camera_component, feedback_pin=got.feedback_pin
    )
    faults = Faults(
        *(got.drop, got.repeat, got.delay, got.jitter),
        reject_item=got.reject_item,
        cut_at_item=got.cut_at_item,
        miss_photo_share=got.miss_photos,
    )
    server = VehicleServer(options, got.udp, speed_up=got.speed_up, faults=faults, seed=got.seed)
    print(f"{got.flavour} vehicle, sending to {got.udp[0]}:{got.udp[1]}, {got.speed_up:g} times real time")
    with contextlib.suppress(KeyboardInterrupt):
        server.run()


if __name__ == "__main__":
    main()
