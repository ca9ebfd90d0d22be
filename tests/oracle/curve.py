"""Space-filling curves bit by bit in Python integers. Imports nothing from gsim3d."""

CURVES = ("z", "z-trans", "hilbert", "hilbert-trans")


def interleaved_bits(axes, depth):
    """Bits from high to low: of every level the bit of the first, the second and the third axis."""
    return [(axis >> level) & 1 for level in reversed(range(depth)) for axis in axes]


def number(bits):
    value = 0
    for bit in bits:
        value = 2 * value + bit
    return value


def code(x, y, z, curve, depth):
    axes = [y, x, z] if curve.endswith("-trans") else [x, y, z]
    if curve.startswith("z"):
        return number(interleaved_bits(axes, depth))
    # Skilling 2004: undo the excess work of every level, then read the transposed index as a Gray code.
    for level in reversed(range(depth)):
        below = 2**level - 1
        for a in range(3):
            if axes[a] & 2**level:
                axes[0] ^= below
            else:
                exchange = (axes[0] ^ axes[a]) & below
                axes[0] ^= exchange
                axes[a] ^= exchange
    bits = interleaved_bits(axes, depth)
    for i in range(1, len(bits)):
        bits[i] ^= bits[i - 1]
    return number(bits)
