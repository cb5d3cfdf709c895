"""Bytes of good files, changed as disks, networks and careless exporters change them."""

from __future__ import annotations

import numpy as np

NUMBERS = (b"-1", b"0", b"nan", b"inf", b"1e308", b"99999999999", b"4294967295", b"x", b"1 2")


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """One to four changes: bytes set, cut out, doubled, cut off; words replaced by odd numbers."""
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        # half of the changes hit the header, where the promises stand
        reach = len(out) if rng.random() < 0.5 else min(len(out), 400)
        if reach == 0:
            break
        at = int(rng.integers(reach))
        way = int(rng.integers(6))
        if way == 0:
            out[at] = int(rng.integers(256))
        elif way == 1:
            out[at] ^= 1 << int(rng.integers(8))
        elif way == 2:
            del out[at : at + int(rng.integers(1, 12))]
        elif way == 3:
            piece = out[at : at + int(rng.integers(1, 40))]
            out[at:at] = piece
        elif way == 4:
            del out[at:]
        else:
            stop = at
            while stop < len(out) and out[stop : stop + 1].isalnum():
                stop += 1
            out[at:stop] = NUMBERS[int(rng.integers(len(NUMBERS)))]
    return bytes(out)
