"""What the served variables and the page answer, and to whom: run in a network of its own.

`unshare -rn python -m tests.live.alone` gives this computer a second address, 10.9.9.1, asks for a
variable at both by raw datagrams, and prints where is listened and who was answered, as JSON.
"""

from __future__ import annotations

import asyncio
import json
import socket
import struct
import subprocess

from beamfit.live.page import page
from beamfit.live.served import served

OTHER, SEARCH = "10.9.9.1", 5076


def search(name: str, port: int) -> bytes:
    """A request for a variable, of PV Access: protocol version 2, little endian, answer wanted."""
    word = name.encode()
    body = struct.pack("<I", 1) + b"\x81\0\0\0" + bytes(10) + b"\xff\xff" + bytes(4)
    body += struct.pack("<H", port) + b"\x01\x03tcp" + struct.pack("<HI", 1, 7)
    body += bytes([len(word)]) + word
    return b"\xca\x02\0\x03" + struct.pack("<I", len(body)) + body


def answered(address: str) -> bool:
    """Whether somebody answers a search that is sent to an address of this computer."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind((address, 0))
        one.settimeout(0.3)
        for _ in range(10):
            one.sendto(search("WATCH:STATUS", one.getsockname()[1]), (address, SEARCH))
            try:
                return bool(one.recv(2048))
            except TimeoutError:
                continue
    return False


def listening() -> list[str]:
    """Addresses at which this computer accepts connections."""
    rows = subprocess.run(["ss", "-Hlnt"], check=True, capture_output=True, text=True).stdout
    return sorted({row.split()[3].rpartition(":")[0] for row in rows.splitlines()})


async def main() -> None:
    for command in ("link set lo up", f"address add {OTHER}/32 dev lo"):
        subprocess.run(["ip", *command.split()], check=True)
    async with page("127.0.0.1", 0):
        with served("WATCH:", "127.0.0.1"):
            found = {address: answered(address) for address in ("127.0.0.1", OTHER)}
            print(json.dumps({"answered": found, "listening": listening()}))


if __name__ == "__main__":
    asyncio.run(main())
