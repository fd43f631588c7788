"""The colours of the pictures, and a fixed palette of their blends: small files whose colours are true."""

from functools import cache
from itertools import combinations

import numpy as np
from PIL import Image

# Okabe and Ito's palette: told apart by the colour-blind, and on grey paper by their lightness.
BEFORE, AFTER, LAW, READING = "#D55E00", "#0072B2", "#009E73", "#666666"
SHADE, GRID = "#f3efe2", "#e6e6e6"
_GROUNDS = ("#ffffff", SHADE)
_ON_GROUND = 10  # steps from a ground to a colour
_BETWEEN = 4  # steps from one colour to another


def in_palette(image: Image.Image) -> Image.Image:
    """An RGB image in the palette's colours.

    A palette chosen by the picture itself would turn a few blue dots green, and the legend with them.
    """
    return image.quantize(palette=_palette(), dither=Image.Dither.NONE)


@cache
def _palette() -> Image.Image:
    inks = (BEFORE, AFTER, LAW, READING)
    pairs = [(ground, ink, _ON_GROUND) for ground in _GROUNDS for ink in (*inks, "#000000")]
    # No step between grid and ground: Pillow looks up cells of four levels, and white would turn grey.
    pairs += [(ground, GRID, 1) for ground in _GROUNDS]
    pairs += [(*pair, _BETWEEN) for pair in combinations(inks, 2)]
    blends = np.concatenate([np.linspace(_rgb(a), _rgb(b), steps + 1) for a, b, steps in pairs])
    holder = Image.new("P", (1, 1))
    holder.putpalette(np.unique(blends.round().astype(np.uint8), axis=0).tobytes())
    return holder


def _rgb(colour: str) -> tuple[int, ...]:
    return tuple(bytes.fromhex(colour[1:]))
