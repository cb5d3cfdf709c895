# mypy: disable-error-code="no-untyped-def"
"""MeatPack's characters in machine code (Scott Mudge; Prusa's libbgcode, meatpack.cpp)."""

from __future__ import annotations

from gcode.compiled import njit

SIGNAL, PACK, UNPACK, RESET, NO_SPACES, SPACES = 255, 251, 250, 249, 247, 246


@njit(inner=True, cache=True, nogil=True)
def put(out, count, character, parameters, spaced):
    """One character, with a space before a parameter of a G-code; the new count, and `spaced`."""
    begins = count == 0 or out[count - 1] == 10
    if character == 10:
        if begins:  # no empty lines
            return count, False
        spaced = False
    elif begins:
        spaced = character == 71
    elif spaced and parameters[character] and out[count - 1] != 32:
        out[count] = 32
        count += 1
    out[count] = character
    return count + 1, spaced


@njit(cache=True, nogil=True)
def unpack(source, nibbles, parameters, out):
    """MeatPack's characters; how many there are. `out` has room for four times the source."""
    packing, no_spaces, spaced = False, False, False
    signals, whole, behind, count = 0, 0, -1, 0
    for at in range(len(source)):
        byte = source[at]
        if byte == SIGNAL and signals < 2 and whole == 0:
            signals += 1
            continue
        if signals == 2:
            signals = 0
            if byte == PACK:
                packing = True
            elif byte in (UNPACK, RESET):
                packing = False
            elif byte in (NO_SPACES, SPACES):
                no_spaces = byte == NO_SPACES
            continue
        if signals == 1:  # both characters of the pair are whole
            signals, whole = 0, 2
        if not packing:
            count, spaced = put(out, count, byte, parameters, spaced)
            continue
        if whole > 0:
            count, spaced = put(out, count, byte, parameters, spaced)
            whole -= 1
            if behind >= 0:
                count, spaced = put(out, count, behind, parameters, spaced)
                behind = -1
            continue
        low, high = byte & 15, byte >> 4
        first = 69 if low == 11 and no_spaces else nibbles[low]
        second = 69 if high == 11 and no_spaces else nibbles[high]
        if low == 15:
            whole = 1
            if high == 15:
                whole = 2
            else:
                behind = second
            continue
        count, spaced = put(out, count, first, parameters, spaced)
        if first == 10:  # what is behind the end of a line only fills the byte
            continue
        if high == 15:
            whole = 1
        else:
            count, spaced = put(out, count, second, parameters, spaced)
    return count
