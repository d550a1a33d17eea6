"""Damaged forms of valid files, seeded: bytes flipped, cut, doubled, swapped between samples; numbers and words made
extreme; brackets nested deep."""

from __future__ import annotations

import random
import re

_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?")
_EXTREMES = (
    b"-1", b"0", b"1e309", b"-1e309", b"1e-320", b"NaN", b"Infinity", b"9223372036854775808", b"4294967295", b"-0.0",
    b"99999999999999999999999999999999", b"0x10", b"1_000", b"true", b"null", b'""', b"[]", b"{}", b"inf", b"nan",
)  # fmt: skip
_WORDS = (
    b"\x00", b"\xff\xfe", b"\xed\xa0\x80", "\u202e\u0000".encode(), b"../../../etc/passwd", b"'", b'"', b"\\", b"%s%n",
    b"[" * 3000, b"{" * 3000, b'{"a":' * 1500, b"a" * 5000, b"\n", b"\r\n", b"=", b"]", b"}", b",", b"#", b"[[x]]",
)  # fmt: skip


def mutate(samples: list[bytes], chance: random.Random) -> bytes:
    """One damaged input."""
    data = bytearray(chance.choice(samples))
    for _ in range(1 + int(chance.expovariate(0.7))):
        _step(data, samples, chance)
        if len(data) > 200_000:
            del data[200_000:]
    return bytes(data)


def _step(data: bytearray, samples: list[bytes], chance: random.Random) -> None:
    kind = chance.randrange(10)
    at = chance.randrange(len(data) + 1)
    length = min(int(chance.expovariate(1 / 12)) + 1, len(data) - at)
    if kind == 0 and data:
        data[min(at, len(data) - 1)] ^= 1 << chance.randrange(8)
    elif kind == 1:
        del data[at:]
    elif kind == 2:
        del data[at : at + length]
    elif kind == 3:
        data[at:at] = data[at : at + length] * chance.choice((1, 2, 50))
    elif kind == 4:
        other = chance.choice(samples)
        begin = chance.randrange(len(other) + 1)
        data[at : at + length] = other[begin : begin + chance.randrange(1, 60)]
    elif kind in (5, 6):
        found = list(_NUMBER.finditer(bytes(data[:20_000])))
        if found:
            match = chance.choice(found)
            data[match.start() : match.end()] = chance.choice(_EXTREMES)
    elif kind == 7:
        data[at:at] = chance.choice(_WORDS)
    elif kind == 8:
        data[at : at + length] = chance.randbytes(length)
    elif len(data) >= 4:
        at = chance.randrange(len(data) - 3)
        value = chance.choice((0, 1, 0x7FFFFFFF, 0xFFFFFFFF, 0x80000000, len(data), chance.getrandbits(32)))
        data[at : at + 4] = value.to_bytes(4, "little")
