#!/usr/bin/env python3
"""Checks tags and robot against a foreign Bluetooth implementation: Google's bumble.

Needs `pip install bumble` (0.0.236 was used). Two parts:

- bumble is the robot's stack. It joins the virtual air of crates/link over TCP and does what a robot
  does: scan with scan responses, discover, read, command, be notified, be refused, pair (Just Works
  and passkey), read what is encrypted.
- bumble is the radio. `vergence-tagd` and `vergence tag` each get one of its virtual controllers over
  TCP; the robot discovers the tag, is refused, pairs, reads what is encrypted, commands, writes.

    python3 scripts/check_bumble.py
"""

import asyncio
import re
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

from bumble.controller import Controller
from bumble.core import UUID, ProtocolError
from bumble.device import Device
from bumble.hci import Address
from bumble.link import LocalLink
from bumble.pairing import PairingConfig, PairingDelegate
from bumble.transport import open_transport

BASE = "6f1c000{}-8a52-4d3b-b1f7-2e90c45ad617"
SERVICE, RECORD, _REST, _WRITE, COMMAND, STATE = (UUID(BASE.format(k)) for k in range(1, 7))
CUP, CAN, BOX = (f"C0:01:02:03:04:0{k}" for k in (1, 2, 3))
PASSKEY = 123456
# Play "10", 50 ms a chip, without end, on the first LED, at full drive.
PLAY = bytes([1, 0, 255, 2]) + (1).to_bytes(8, "little") + (50_000).to_bytes(4, "little") + bytes(4)


class Passkey(PairingDelegate):
    """Types the passkey that is printed on the tag."""

    def __init__(self, passkey):
        super().__init__(PairingDelegate.KEYBOARD_INPUT_ONLY)
        self.passkey = passkey

    async def get_number(self):
        return self.passkey


def check(what, good, said=""):
    print(f"{'ok  ' if good else 'FAIL'} {what}")
    if not good:
        raise SystemExit(said or 1)


async def scan(device):
    heard = {}

    def hear(advertisement):
        data = heard.setdefault(str(advertisement.address).split("/")[0], b"")
        heard[str(advertisement.address).split("/")[0]] = data + bytes(advertisement.data)

    device.on("advertisement", hear)
    await device.start_scanning(active=True, filter_duplicates=False)
    await asyncio.sleep(1.5)
    await device.stop_scanning()
    return heard


async def tag(device, address):
    """Connects and finds the characteristics by their UUIDs."""
    connection = await device.connect(Address(address, Address.RANDOM_DEVICE_ADDRESS))
    peer = await connection_peer(connection)
    return connection, {c.uuid: c for s in peer.services for c in s.characteristics}


async def connection_peer(connection):
    from bumble.device import Peer

    peer = Peer(connection)
    await peer.request_mtu(247)
    await peer.discover_services()
    for service in peer.services:
        await service.discover_characteristics()
    return peer


async def refused(operation):
    try:
        await operation
    except ProtocolError as error:
        return error
    return None


async def run(port):
    async with await open_transport(f"tcp-client:127.0.0.1:{port}") as transport:
        device = Device.with_hci(
            "foreign robot", Address("F0:F1:F2:F3:F4:F5"), transport.source, transport.sink
        )
        await device.power_on()
        heard = await scan(device)
        check("three tags heard", {CUP, CAN, BOX} <= set(heard))
        check("the scan response names the cup", b"cup" in heard[CUP])
        check("the advertisement has the service", bytes(SERVICE) in heard[CUP])

        connection, found = await tag(device, CUP)
        check("record read", b"cup" in await found[RECORD].read_value())
        check("state read", (await found[STATE].read_value())[0] == 2)
        firmware = found[UUID.from_16_bits(0x2A26)]
        check("firmware version", re.match(rb"\d+\.\d+", await firmware.read_value()))
        check("battery level", await found[UUID.from_16_bits(0x2A19)].read_value() == bytes([80]))
        states = asyncio.Queue()
        await found[STATE].subscribe(states.put_nowait)
        await found[COMMAND].write_value(PLAY, with_response=True)
        state = await asyncio.wait_for(states.get(), 2)
        check("commanded, and notified of the light", state[0] & 1 == 1)
        wrong = await refused(found[COMMAND].write_value(b"\x07", with_response=True))
        check("nonsense is refused", wrong is not None and wrong.error_code == 0x80)
        await connection.disconnect()

        connection, found = await tag(device, CAN)
        error = await refused(found[RECORD].read_value())
        check("unpaired read refused", error is not None and error.error_code in (0x05, 0x0F))
        device.pairing_config_factory = lambda _: PairingConfig(
            sc=True, mitm=False, bonding=True, delegate=PairingDelegate()
        )
        await connection.pair()
        check("Just Works pairing encrypts", connection.is_encrypted)
        check("encrypted record read", b"can" in await found[RECORD].read_value())
        await connection.disconnect()

        connection, found = await tag(device, BOX)
        device.pairing_config_factory = lambda _: PairingConfig(
            sc=True, mitm=True, bonding=True, delegate=Passkey(PASSKEY)
        )
        await connection.pair()
        check("passkey pairing encrypts", connection.is_encrypted)
        check("authenticated record read", b"box" in await found[RECORD].read_value())
        await connection.disconnect()


TAG_SETTINGS = """
store = "{folder}/tag.flash"
passkey = {passkey}
record_access = "encrypted"
controller = {{ tcp = "127.0.0.1:{port}" }}
lights = [{{ led = "{folder}/led" }}]
"""
RECORD_FILE = """
object_id = "{id}"
landmarks = [{{ position = [0.04, 0.0, 0.0], normal = [1.0, 0.0, 0.0] }}]
bounding_box = {{ width = 0.08, length = 0.08, height = 0.09 }}
shape = {{ kind = "box" }}
"""


async def vergence(folder, *arguments):
    """Runs a command of the robot; its exit status and all that it said."""
    process = await asyncio.create_subprocess_exec(
        "target/debug/vergence", *arguments, "--config", f"{folder}/workcell.toml",
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )
    said, _ = await asyncio.wait_for(process.communicate(), 60)
    return process.returncode, said.decode()


async def foreign_radio(folder):
    """Our tag and our robot, each on a controller of bumble's."""
    air = LocalLink()
    ports, controllers = [], []
    for name in ("tag", "robot"):
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            ports.append(probe.getsockname()[1])
        transport = await open_transport(f"tcp-server:127.0.0.1:{ports[-1]}")
        controllers.append(
            Controller(name, host_source=transport.source, host_sink=transport.sink, link=air)
        )
    led = folder / "led"
    led.mkdir()
    (led / "max_brightness").write_text("255")
    (folder / "tag.toml").write_text(
        TAG_SETTINGS.format(folder=folder, passkey=PASSKEY, port=ports[0])
    )
    for name in ("cup", "mug"):
        (folder / f"{name}.toml").write_text(RECORD_FILE.format(id=name))
    subprocess.run(["target/debug/vergence", "workcell", folder], check=True, stdout=subprocess.DEVNULL)
    config = folder / "workcell.toml"
    radio = f'[radio]\ndriver = "hci"\ntcp = "127.0.0.1:{ports[1]}"\nbonds = "tags.bonds"'
    config.write_text(config.read_text().replace('[radio]\ndriver = "sim"', radio))

    tag = await asyncio.create_subprocess_exec(
        "target/debug/vergence-tagd", folder / "tag.toml", "--record", folder / "cup.toml",
        stderr=subprocess.PIPE,
    )
    try:
        hello = (await asyncio.wait_for(tag.stderr.readline(), 10)).decode()
        address = re.search(r"tag ([0-9A-F:]{17})", hello).group(1)
        # bumble delivers no scan responses, so that the tag goes by its address.
        status, said = await vergence(folder, "tag", "info", address)
        check("our robot meets our tag", status == 0 and "Linux board" in said, said)
        check("unpaired, the record is refused", "not for this robot" in said, said)
        wrong = await vergence(folder, "tag", "pair", address, "--passkey", "000001")
        check("a wrong passkey is refused", wrong[0] == 1 and "pairing failed" in wrong[1], wrong[1])
        await asyncio.sleep(2.5)
        paired = await vergence(folder, "tag", "pair", address, "--passkey", str(PASSKEY))
        check("paired by passkey", paired[0] == 0, paired[1])
        status, said = await vergence(folder, "tag", "info", address)
        check("encrypted record read with the kept bond", status == 0 and "yes, not signed" in said, said)
        blink = asyncio.create_task(
            vergence(folder, "tag", "blink", address, "--pattern", "10", "--seconds", "1")
        )
        levels = set()
        while not blink.done():
            levels.add((led / "brightness").read_text())
            await asyncio.sleep(0.01)
        check("commanded, and its LED blinks", (await blink)[0] == 0 and {"0", "255"} <= levels)
        written = await vergence(folder, "tag", "write", str(folder / "mug.toml"), "--to", address)
        check("a new record is written", written[0] == 0, written[1])
        status, said = await vergence(folder, "tag", "info", address)
        check("and the tag serves it", status == 0 and "yes, not signed" in said, said)
    finally:
        tag.kill()
        await tag.wait()


def main():
    command = ["cargo", "run", "--quiet", "-p", "vergence-link", "--example", "tag_server"]
    server = subprocess.Popen([*command, "--", "127.0.0.1:0"], stdout=subprocess.PIPE, text=True)
    try:
        port = server.stdout.readline().rsplit(":", 1)[1].strip()
        asyncio.run(asyncio.wait_for(run(port), 60))
    finally:
        server.kill()
    subprocess.run(["cargo", "build", "-q", "-p", "vergence-cli", "-p", "vergence-tagd"], check=True)
    with tempfile.TemporaryDirectory() as folder:
        asyncio.run(asyncio.wait_for(foreign_radio(Path(folder)), 180))
    print("all good")
    return 0


if __name__ == "__main__":
    sys.exit(main())
