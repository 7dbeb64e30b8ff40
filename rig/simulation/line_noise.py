"""What a bad line does to bytes: flipped bits, lost and invented bytes, repeats, splices.

Used by the virtual device to spoil its lines on demand and by the tests to try the parsers.
"""

from __future__ import annotations

from random import Random

__all__ = ["SPOILS", "spoil"]


def _flip(data: bytes, rng: Random) -> bytes:
    """Flip one to eight bits."""
    spoilt = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        spoilt[rng.randrange(len(spoilt))] ^= 1 << rng.randrange(8)
    return bytes(spoilt)


def _replace(data: bytes, rng: Random) -> bytes:
    """Put random bytes over a stretch."""
    start, end = _stretch(data, rng)
    return data[:start] + rng.randbytes(end - start) + data[end:]


def _lose(data: bytes, rng: Random) -> bytes:
    """Lose a stretch, as an overrun does."""
    start, end = _stretch(data, rng)
    return data[:start] + data[end:]


def _invent(data: bytes, rng: Random) -> bytes:
    """Put random bytes in between."""
    at = rng.randint(0, len(data))
    return data[:at] + rng.randbytes(rng.randint(1, 40)) + data[at:]


def _digit(data: bytes, rng: Random) -> bytes:
    """Change one to four digits into others: the worst case, since the grammar stays right."""
    places = [k for k, byte in enumerate(data) if 48 <= byte <= 57]
    spoilt = bytearray(data)
    for place in rng.sample(places, min(len(places), rng.randint(1, 4))):
        spoilt[place] = rng.choice(b"0123456789")
    return bytes(spoilt)


def _cut(data: bytes, rng: Random) -> bytes:
    """Keep only the head."""
    return data[: rng.randrange(len(data))]


def _stretch(data: bytes, rng: Random) -> tuple[int, int]:
    start = rng.randrange(len(data))
    return start, min(len(data), start + rng.randint(1, 20))


#: The ways to spoil, by name.
SPOILS = {
    "flip": _flip,
    "replace": _replace,
    "lose": _lose,
    "invent": _invent,
    "digit": _digit,
    "cut": _cut,
}


def spoil(data: bytes, rng: Random) -> bytes:
    """Return the bytes spoilt in one random way; they may by chance come out as they were.

    Examples
    --------
    >>> spoil(b"7 read*06EC81", Random(1))
    b'7 read*064LA1'
    """
    return rng.choice(list(SPOILS.values()))(data, rng) if data else data
