#!/usr/bin/env python3
"""Checks signed records against a foreign implementation of COSE (RFC 9052): pycose.

Needs `pip install pycose` (1.1.0 was used). Ours signs and pycose verifies; pycose signs and ours
judges; what was changed, and what another key signed, is told apart by both.

    cargo build -p vergence-tag --features signature --example sign_record
    python3 scripts/check_cose.py target/debug/examples/sign_record
"""

import hashlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import cbor2
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
)
from pycose.algorithms import Es256
from pycose.headers import KID, Algorithm, ContentType
from pycose.keys import EC2Key
from pycose.messages import CoseMessage, Sign1Message

RECORD = {
    "object_id": "cup",
    "landmarks": [{"position": [0.04, 0.0, 0.0], "normal": [1, 0, 0]}],
    "bounding_box": {"width": 0.08, "length": 0.08, "height": 0.09},
    "shape": {"kind": "box"},
}


def check(what, good):
    print(f"{'ok  ' if good else 'FAIL'} {what}")
    if not good:
        raise SystemExit(1)


class Owner:
    """A key in the forms that both sides read."""

    def __init__(self, folder, name, form):
        self.private, self.public = folder / f"{name}.pem", folder / f"{name}.pub"
        key = ec.generate_private_key(ec.SECP256R1())
        self.private.write_bytes(key.private_bytes(Encoding.PEM, form, NoEncryption()))
        self.public.write_bytes(
            key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
        )
        numbers = key.private_numbers()
        x, y, d = (
            n.to_bytes(32, "big")
            for n in (numbers.public_numbers.x, numbers.public_numbers.y, numbers.private_value)
        )
        self.cose = EC2Key(crv="P_256", x=x, y=y, d=d)
        # RFC 9679: SHA-256 of the key's required parameters in deterministic CBOR.
        self.thumbprint = hashlib.sha256(
            cbor2.dumps({1: 2, -1: 1, -2: x, -3: y}, canonical=True)
        ).digest()


def main():
    program = sys.argv[1]

    def judge(owner, path):
        return subprocess.run(
            [program, "judge", owner.public, path], capture_output=True, text=True, check=True
        ).stdout.strip()

    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        ours = Owner(folder, "pkcs8", PrivateFormat.PKCS8)
        other = Owner(folder, "sec1", PrivateFormat.TraditionalOpenSSL)
        (folder / "record.json").write_text(json.dumps(RECORD))
        signed = folder / "signed.cose"
        for owner in (ours, other):
            subprocess.run(
                [program, "sign", owner.private, folder / "record.json", signed], check=True
            )
            message = CoseMessage.decode(signed.read_bytes())
            check("pycose reads our envelope", isinstance(message, Sign1Message))
            check("its algorithm is ES256, and signed", message.phdr == {Algorithm: Es256})
            check("its key id is a thumbprint's beginning", message.uhdr[KID] == owner.thumbprint[:8])
            message.key = owner.cose
            check("pycose verifies our signature", message.verify_signature())
            check("its payload is the record", cbor2.loads(message.payload)[0] == "cup")
        message.key = ours.cose
        check("pycose refuses another key", not message.verify_signature())

        record = message.payload
        foreign = folder / "foreign.cose"
        for headers in ({KID: b"somebody"}, {KID: ours.thumbprint[:8], ContentType: 60}, {}):
            message = Sign1Message(phdr={Algorithm: Es256}, uhdr=headers, payload=record)
            message.key = ours.cose
            foreign.write_bytes(message.encode())
            check(f"we verify pycose's, {len(headers)} headers", judge(ours, foreign) == "cup: signed by this key")
            check("and do not trust another key", "not trusted" in judge(other, foreign))
            changed = foreign.read_bytes().replace(b"cup", b"cap", 1)
            foreign.write_bytes(changed)
            verdict = judge(ours, foreign)
            check("and notice a change", verdict.startswith("cap: ") and "signed by this key" not in verdict)
        message = Sign1Message(phdr={}, uhdr={Algorithm: Es256}, payload=record)
        message.key = ours.cose
        foreign.write_bytes(message.encode())
        check("an algorithm that is not signed does not count", "wrong" in judge(ours, foreign))
    print("all good")
    return 0


if __name__ == "__main__":
    sys.exit(main())
