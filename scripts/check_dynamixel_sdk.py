#!/usr/bin/env python3
"""ROBOTIS' own SDK (PyPI: dynamixel-sdk) against our emulated servo bus, protocols 1.0 and 2.0.

    cargo build -p vergence-devices --example virtual_servo_bus
    python3 scripts/check_dynamixel_sdk.py target/debug/examples/virtual_servo_bus

Exit status 0 when every check holds. With --packets it prints what the SDK sends, byte by byte: the
golden packets in crates/devices/src/dynamixel/packet.rs come from there.
"""

import subprocess
import sys
import time

from dynamixel_sdk import (
    COMM_RX_TIMEOUT,
    COMM_SUCCESS,
    GroupSyncRead,
    GroupSyncWrite,
    PacketHandler,
    PortHandler,
)

checks = 0


def check(what, got, wanted):
    """Counts a check, stops at the first that fails."""
    global checks
    if got != wanted:
        sys.exit(f"FAILED {what}: got {got}, wanted {wanted}")
    checks += 1


def wait_for(read, wanted, what):
    """A servo needs time to arrive."""
    deadline = time.monotonic() + 5.0
    value = None
    while time.monotonic() < deadline:
        value = read()
        if value == wanted:
            break
        time.sleep(0.02)
    check(what, value, wanted)


def protocol_one(port):
    handler = PacketHandler(1.0)
    check("1.0 ping", handler.ping(port, 1), (12, COMM_SUCCESS, 0))
    check("1.0 absent servo", handler.ping(port, 7)[1], COMM_RX_TIMEOUT)
    check("1.0 read temperature", handler.read1ByteTxRx(port, 1, 43), (35, COMM_SUCCESS, 0))
    check("1.0 torque on", handler.write1ByteTxRx(port, 1, 24, 1), (COMM_SUCCESS, 0))
    check("1.0 speed", handler.write2ByteTxRx(port, 1, 32, 500), (COMM_SUCCESS, 0))
    check("1.0 goal", handler.write2ByteTxRx(port, 1, 30, 300), (COMM_SUCCESS, 0))
    wait_for(lambda: handler.read2ByteTxRx(port, 1, 36)[0], 300, "1.0 arrives")
    check("1.0 not moving", handler.read1ByteTxRx(port, 1, 46)[0], 0)
    check("1.0 goal out of range", handler.write2ByteTxRx(port, 1, 30, 2000), (COMM_SUCCESS, 2))
    group = GroupSyncWrite(port, handler, 30, 2)
    for servo, goal in ((1, 400), (2, 0x02FF)):
        check("1.0 sync write", group.addParam(servo, [goal & 0xFF, goal >> 8]), True)
    check("1.0 sync write sent", group.txPacket(), COMM_SUCCESS)
    wait_for(lambda: handler.read2ByteTxRx(port, 2, 36)[0], 0x02FF, "1.0 sync write arrives")
    check("1.0 prepared write", handler.regWriteTxRx(port, 1, 30, 2, [0x20, 0x03])[0], COMM_SUCCESS)
    check("1.0 not yet", handler.read2ByteTxRx(port, 1, 30)[0], 400)
    check("1.0 action", handler.action(port, 1), COMM_SUCCESS)
    wait_for(lambda: handler.read2ByteTxRx(port, 1, 30)[0], 0x0320, "1.0 action obeyed")


def keep_stuffing(handler):
    """The SDK (4.1.0) stuffs a copy of the packet and then sends the original: make it send the copy."""
    stuff = handler.addStuffing

    def in_place(packet):
        packet[:] = stuff(packet)

    handler.addStuffing = in_place


def protocol_two(port):
    handler = PacketHandler(2.0)
    keep_stuffing(handler)
    check("2.0 ping", handler.ping(port, 11), (1060, COMM_SUCCESS, 0))
    found, result = handler.broadcastPing(port)
    check("2.0 broadcast ping", result, COMM_SUCCESS)
    check("2.0 broadcast finds", {i: v[0] for i, v in found.items()}, {11: 1060, 12: 1060})
    check("2.0 absent servo", handler.ping(port, 7)[1], COMM_RX_TIMEOUT)
    check("2.0 torque on", handler.write1ByteTxRx(port, 11, 64, 1), (COMM_SUCCESS, 0))
    check("2.0 locked while torque is on", handler.write1ByteTxRx(port, 11, 9, 0)[1], 7)
    check("2.0 goal", handler.write4ByteTxRx(port, 11, 116, 1000), (COMM_SUCCESS, 0))
    wait_for(lambda: handler.read4ByteTxRx(port, 11, 132)[0], 1000, "2.0 arrives")
    check("2.0 goal out of range", handler.write4ByteTxRx(port, 11, 116, 5000)[1], 6)
    # FF FF FD in the data must be stuffed on the way in and on the way out. The place (indirect
    # data) means nothing to the servo.
    for value in (0x00FDFFFF, 0xFDFFFF00, 0x12345678, 0xFDFDFFFF):
        check("2.0 stuffed write", handler.write4ByteTxRx(port, 11, 224, value), (COMM_SUCCESS, 0))
        check("2.0 stuffed read", handler.read4ByteTxRx(port, 11, 224), (value, COMM_SUCCESS, 0))
    group = GroupSyncWrite(port, handler, 116, 4)
    for servo, goal in ((11, 1500), (12, 2500)):
        check("2.0 sync write", group.addParam(servo, list(goal.to_bytes(4, "little"))), True)
    check("2.0 torque on", handler.write1ByteTxRx(port, 12, 64, 1), (COMM_SUCCESS, 0))
    check("2.0 sync write sent", group.txPacket(), COMM_SUCCESS)
    reader = GroupSyncRead(port, handler, 132, 4)
    check("2.0 sync read", reader.addParam(11) and reader.addParam(12), True)

    def both():
        check("2.0 sync read answered", reader.txRxPacket(), COMM_SUCCESS)
        return [reader.getData(servo, 132, 4) for servo in (11, 12)]

    wait_for(both, [1500, 2500], "2.0 sync write arrives")
    check("2.0 reboot", handler.reboot(port, 11), (COMM_SUCCESS, 0))
    check("2.0 torque off after reboot", handler.read1ByteTxRx(port, 11, 64)[0], 0)


def main():
    packets = "--packets" in sys.argv
    arguments = [a for a in sys.argv[1:] if not a.startswith("--")]
    if len(arguments) != 1:
        sys.exit(__doc__)
    bus = subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        port = PortHandler(bus.stdout.readline().strip())
        if packets:
            send = port.writePort
            port.writePort = lambda packet: print(bytes(packet).hex(" ")) or send(packet)
        check("open", port.openPort(), True)
        check("baud rate", port.setBaudRate(1_000_000), True)
        # Several rounds: one bus serves one master after the other, and both protocols in turn.
        for _ in range(2):
            protocol_one(port)
            protocol_two(port)
        port.closePort()
    finally:
        bus.stdin.close()
        bus.wait(timeout=10)
    print(f"{checks} checks of dynamixel-sdk against the emulated bus hold")


if __name__ == "__main__":
    main()
