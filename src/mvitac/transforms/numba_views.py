"""Random views on CPUs in one pass per image, compiled by numba: crop, resize, flip, grayscale, normalisation.

It uses the fixed-point arithmetic of torch's antialiased uint8 resize and gives the same levels, bit for bit. In each
direction a level is a weighted sum over whole lines (rows of the image along the height, gathered pixels along the width),
which LLVM vectorises. Pixels are handled as four bytes, the last of them unused, so that one read fetches a pixel.
"""

# pyright: reportCallIssue=false
# (numba passes the first parameter of an intrinsic, not the caller)
from contextlib import suppress
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

MAX_SHRINK = 1.5
"""Largest ratio of image side to view side. Up to it a level is a sum of at most ``TERMS`` neighbours; beyond it the gain
over torch is small."""
TERMS = 3

# Without these types numba would compute in 64 bits; a vector holds four times as many 16-bit multipliers.
I32, U8 = ir.IntType(32), ir.IntType(8)


@intrinsic
def _plus_product(_: Any, total: Any, level: Any, weight: Any) -> Any:
    """int32 ``total`` + uint8 ``level`` * int16 ``weight``."""

    def generate(_context: Any, builder: Any, _signature: Any, given: Any) -> Any:
        product = builder.mul(builder.zext(given[1], I32), builder.sext(given[2], I32), flags=["nsw"])
        return builder.add(given[0], product, flags=["nsw"])

    return types.int32(types.int32, types.uint8, types.int16), generate


@intrinsic
def _level(_: Any, total: Any, precision: Any) -> Any:
    """uint8: integer part of a weighted sum, which is an int32 with ``precision`` fractional bits."""

    def generate(_context: Any, builder: Any, _signature: Any, given: Any) -> Any:
        return builder.trunc(builder.lshr(given[0], given[1]), U8)

    return types.uint8(types.int32, types.int32), generate


@intrinsic
def _fma(_: Any, a: Any, b: Any, c: Any) -> Any:
    """float32 ``a`` * ``b`` + ``c``, rounded once, as in torch.addcmul."""

    def generate(_context: Any, builder: Any, _signature: Any, given: Any) -> Any:
        return builder.fma(*given)

    return types.float32(types.float32, types.float32, types.float32), generate


@intrinsic
def _byte(_: Any, pixel: Any, shift: Any) -> Any:
    """uint8: eight bits of uint32 ``pixel``, from bit ``shift``."""

    def generate(_context: Any, builder: Any, _signature: Any, given: Any) -> Any:
        return builder.trunc(builder.lshr(given[0], builder.trunc(given[1], I32)), U8)

    return types.uint8(types.uint32, types.int64), generate


@njit(nogil=True)
def _filter(length: int, size: int, starts: Any, weights: Any) -> Any:
    """Compute the triangle filter that resizes ``length`` levels to ``size``. When shrinking it is as wide as a step.

    Fills ``starts`` [size], the first source level of each target, and int16 ``weights`` [TERMS, size]. Returns the number
    of terms (2 or 3) and the number of fractional bits of the weights.
    """
    step = length / size
    reach = max(step, 1.0)
    terms, largest = 2, 0.0
    exact = np.zeros(weights.shape)
    for i in range(size):
        centre = step * (i + 0.5)
        first = max(int(centre - reach + 0.5), 0)
        num = min(int(centre + reach + 0.5), length) - first
        total = 0.0
        for k in range(num):
            exact[k, i] = max(1.0 - abs((first + k - centre + 0.5) * (1.0 / reach)), 0.0)
            total += exact[k, i]
        for k in range(num):
            exact[k, i] /= total
            largest = max(largest, exact[k, i])
        starts[i], terms = first, max(terms, num)
    precision = 0
    while int(0.5 + largest * (1 << (precision + 1))) < 1 << 15:
        precision += 1
    for k in range(TERMS):
        for i in range(size):
            weights[k, i] = int(0.5 + exact[k, i] * (1 << precision))
    return terms, np.int32(precision)


@njit(nogil=True)
def _copy(line: Any, out: Any) -> None:
    for j in range(len(line)):
        out[j] = line[j]


@njit(nogil=True)
def _gather(line: Any, places: Any, out: Any) -> None:
    for j in range(len(out)):
        out[j] = line[places[j]]


@njit(nogil=True)
def _pixel(red: Any, green: Any, blue: Any, precision: Any) -> Any:
    red, green, blue = _level(red, precision), _level(green, precision), _level(blue, precision)
    return np.uint32(red) | np.uint32(green) << np.uint32(8) | np.uint32(blue) << np.uint32(16)


# One function for each number of terms: numba counts references to parts of an array that outlive a branch, and a count
# costs as much as dozens of pixels.


@njit(nogil=True)
def _across_2(pixels: Any, weights: Any, precision: Any, out: Any) -> None:
    """Fill a row of pixels, uint32 ``out`` [S], with the sum of ``pixels`` [2, S] times int16 ``weights`` [2, S]."""
    half, p, q, u, v = np.int32(1 << (precision - 1)), pixels[0], pixels[1], weights[0], weights[1]
    for x in range(len(out)):
        a, b = p[x], q[x]
        red = _plus_product(_plus_product(half, _byte(a, 0), u[x]), _byte(b, 0), v[x])
        green = _plus_product(_plus_product(half, _byte(a, 8), u[x]), _byte(b, 8), v[x])
        blue = _plus_product(_plus_product(half, _byte(a, 16), u[x]), _byte(b, 16), v[x])
        out[x] = _pixel(red, green, blue, precision)


@njit(nogil=True)
def _across_3(pixels: Any, weights: Any, precision: Any, out: Any) -> None:
    half, p, q, r = np.int32(1 << (precision - 1)), pixels[0], pixels[1], pixels[2]
    u, v, w = weights[0], weights[1], weights[2]
    for x in range(len(out)):
        a, b, c = p[x], q[x], r[x]
        red = _plus_product(_plus_product(half, _byte(a, 0), u[x]), _byte(b, 0), v[x])
        green = _plus_product(_plus_product(half, _byte(a, 8), u[x]), _byte(b, 8), v[x])
        blue = _plus_product(_plus_product(half, _byte(a, 16), u[x]), _byte(b, 16), v[x])
        red = _plus_product(red, _byte(c, 0), w[x])
        green = _plus_product(green, _byte(c, 8), w[x])
        blue = _plus_product(blue, _byte(c, 16), w[x])
        out[x] = _pixel(red, green, blue, precision)


@njit(nogil=True)
def _down_2(lines: Any, first: int, u: Any, v: Any, precision: Any, out: Any) -> None:
    """Fill a row of levels, uint8 ``out`` [L], with the sum of two ``lines`` [h, L] from ``first`` times ``u`` and ``v``."""
    half, a, b = np.int32(1 << (precision - 1)), lines[first], lines[first + 1]
    for j in range(len(out)):
        out[j] = _level(_plus_product(_plus_product(half, a[j], u), b[j], v), precision)


@njit(nogil=True)
def _down_3(lines: Any, first: int, u: Any, v: Any, w: Any, precision: Any, out: Any) -> None:
    half, a, b, c = np.int32(1 << (precision - 1)), lines[first], lines[first + 1], lines[first + 2]
    for j in range(len(out)):
        out[j] = _level(_plus_product(_plus_product(_plus_product(half, a[j], u), b[j], v), c[j], w), precision)


@njit(nogil=True)
def _bfloat16(value: Any) -> Any:
    """The bits of a float32 rounded to bfloat16, to nearest, ties to even."""
    bits = np.float32(value).view(np.uint32)
    return np.uint16(np.uint32(bits + np.uint32(0x7FFF) + (bits >> np.uint32(16) & np.uint32(1))) >> np.uint32(16))


@njit(nogil=True)
def _normalise(levels: Any, grayscale: bool, tones: Any, line: Any) -> None:
    """Normalise a line of uint8 ``levels`` [S * 4], whose fourth channel is unused, into ``line`` [S * 3]."""
    for x in range(len(line) // 3):
        red, green, blue = np.float32(levels[4 * x]), np.float32(levels[4 * x + 1]), np.float32(levels[4 * x + 2])
        if grayscale:
            red = green = blue = _fma(blue, tones[0, 2], _fma(green, tones[0, 1], red * tones[0, 0]))
        red = _fma(red, tones[1, 0], tones[2, 0])
        green = _fma(green, tones[1, 1], tones[2, 1])
        blue = _fma(blue, tones[1, 2], tones[2, 2])
        if line.itemsize == 4:
            line[3 * x], line[3 * x + 1], line[3 * x + 2] = red, green, blue
        else:
            line[3 * x], line[3 * x + 1], line[3 * x + 2] = _bfloat16(red), _bfloat16(green), _bfloat16(blue)


@njit(nogil=True)
def _resize_rows(
    crop: Any, places: Any, weights: Any, terms: int, precision: Any, channels: int, held: Any, fours: Any, rows: Any
) -> None:
    """Resize the width: fill ``rows`` [h, S] with weighted sums of pixels of ``crop``, uint8 [h, bytes], from ``places``."""
    pixels = np.empty(weights.shape, np.uint32)
    for y in range(len(crop)):
        _copy(crop[y], held)
        for k in range(terms):
            _gather(fours[k * channels :], places, pixels[k])
        if terms == 2:
            _across_2(pixels, weights, precision, rows[y])
        else:
            _across_3(pixels, weights, precision, rows[y])


@njit(nogil=True)
def _finish(
    rows: Any, starts: Any, weights: Any, terms: int, precision: Any, grayscale: bool, tones: Any, out: Any
) -> None:
    """Resize the height of ``rows``, uint8 [h, S * 4], and normalise into ``out`` [S, S * 3]."""
    levels = np.empty(rows.shape[1], np.uint8)
    for y in range(len(out)):
        if terms == 2:
            _down_2(rows, starts[y], weights[0, y], weights[1, y], precision, levels)
        else:
            _down_3(rows, starts[y], weights[0, y], weights[1, y], weights[2, y], precision, levels)
        _normalise(levels, grayscale, tones, out[y])


@njit(nogil=True)
def _views(images: Any, boxes: Any, flip: Any, grayscale: Any, out: Any, tones: Any, held: Any, fours: Any) -> None:
    """``views`` of ``images`` [B, H, W * C]. ``held`` is a byte buffer; ``fours`` [i] reads its bytes i to i + 3."""
    size, channels = out.shape[2:]
    starts, places = np.empty(size, np.int64), np.empty(size, np.uint64)  # unsigned: no negative indices
    weights, turned = np.empty((TERMS, size), np.int16), np.empty((TERMS, size), np.int16)
    rows = np.zeros((images.shape[1] + TERMS, size), np.uint32)
    sensor = np.empty((size if channels > 3 else 0, 3 * size), out.dtype)
    for i in range(len(images)):
        top, left, height, width = boxes[i]
        for channel in range(0, channels, 3):
            terms, precision = _filter(width, size, starts, weights)
            for x in range(size):
                source = size - 1 - x if flip[i] else x
                places[x] = starts[source] * channels
                for k in range(TERMS):
                    turned[k, x] = weights[k, source]
            crop = images[i, top : top + height, left * channels + channel : (left + width) * channels]
            _resize_rows(crop, places, turned, terms, precision, channels, held, fours, rows)
            terms, precision = _filter(height, size, starts, weights)
            lines, gray = rows.view(np.uint8), grayscale[i]
            if channels == 3:
                whole = out[i].reshape(size, 3 * size)
                _finish(lines, starts, weights, terms, precision, gray, tones, whole)
            else:
                _finish(lines, starts, weights, terms, precision, gray, tones, sensor)
                out[i, :, :, channel : channel + 3] = sensor.reshape(size, size, 3)


with suppress(RuntimeError):  # no writable cache: each process compiles again
    _views.enable_caching()


def views(
    images: np.ndarray, boxes: np.ndarray, flip: np.ndarray, grayscale: np.ndarray, out: np.ndarray, tones: np.ndarray
) -> None:
    """Compute random views. Releases the GIL, so that several threads can fill parts of one ``out``.

    All arrays are contiguous. ``images`` are uint8 [B, H, W, C]; ``boxes``, ``flip`` and ``grayscale`` [B] as in
    ``random_views.Drawn``; ``out`` [B, S, S, C] is float32, or the bits of bfloat16 as uint16; ``tones`` float32 [3, 3]
    are the weights of R, G, B in a gray, and factors and offsets of the normalisation.
    """
    assert max(images.shape[1:3]) <= MAX_SHRINK * out.shape[1]
    num, height, width, channels = images.shape
    held = np.zeros((width + TERMS) * channels, np.uint8)  # neighbours beyond the end of a row have weight 0
    fours = np.ndarray(len(held) - 3, np.uint32, held, strides=(1,))
    _views(images.reshape(num, height, width * channels), boxes, flip, grayscale, out, tones, held, fours)
