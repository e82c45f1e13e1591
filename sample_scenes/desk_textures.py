"""Pictures that the desk scene is papered with, drawn with NumPy and Pillow from a seed.

Every function takes a random generator first and returns (height, width, 3) uint8 sRGB. Each picture mixes
details of many sizes, because feature detection needs corners from a millimetre to a decimetre.
"""

import itertools
import math

import numpy as np
from PIL import Image, ImageDraw, ImageFont

Rgb = tuple[int, int, int]

CREAM: Rgb = (240, 230, 208)
INK: Rgb = (38, 36, 42)
NAVY: Rgb = (34, 52, 92)
TEAL: Rgb = (24, 116, 122)
OCHRE: Rgb = (222, 164, 52)
BRICK: Rgb = (176, 66, 44)
MOSS: Rgb = (92, 116, 54)
ROSE: Rgb = (214, 132, 124)
SKY: Rgb = (142, 188, 208)
PLUM: Rgb = (96, 44, 80)
PALETTE = (NAVY, TEAL, OCHRE, BRICK, MOSS, ROSE, SKY, PLUM)

SYLLABLES = ("ra", "lo", "mi", "ten", "ka", "vor", "sel", "an", "tu", "res", "pi", "dor", "ma")
SYLLABLES += ("ne", "los", "quin", "ber", "ta", "fe", "ly", "gra", "on", "sti", "ve", "hal", "cu")


def noise(
    rng: np.random.Generator,
    height: int,
    width: int,
    *,
    cell: float,
    octaves: int = 5,
    gain: float = 0.55,
    stretch: float = 1.0,
) -> np.ndarray:
    """Sum of octaves of smoothed random grids, (height, width), scaled to [0, 1].

    Args:
        cell: size of the largest blobs in pixels; each octave halves it.
        gain: amplitude of an octave relative to the one before.
        stretch: how many times longer than high the blobs are.
    """
    total = np.zeros((height, width))
    for octave in range(octaves):
        size = max(cell / 2**octave, 1.0)
        rows, columns = math.ceil(height / size) + 2, math.ceil(width / (size * stretch)) + 2
        grid = Image.fromarray(rng.standard_normal((rows, columns)).astype(np.float32))
        box = (0.5, 0.5, min(0.5 + width / (size * stretch), columns), min(0.5 + height / size, rows))
        smooth = grid.resize((width, height), Image.Resampling.BICUBIC, box=box)
        total += gain**octave * np.asarray(smooth)
    low, high = np.percentile(total, (0.5, 99.5))
    return np.clip((total - low) / (high - low), 0, 1)


def ramp(values: np.ndarray, *stops: Rgb) -> np.ndarray:
    """Colour scale through equally spaced stops: values (h, w) in [0, 1] to (h, w, 3) float in 0..255."""
    positions = np.linspace(0, 1, len(stops))
    return np.stack([np.interp(values, positions, [stop[c] for stop in stops]) for c in range(3)], axis=-1)


def to_bytes(picture: np.ndarray) -> np.ndarray:
    """Rounded and clipped to uint8."""
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def mottled(rng: np.random.Generator, picture: np.ndarray, *, cell: float, amount: float) -> np.ndarray:
    """The picture with uneven brightness, as paint, print and dirt have it: factor 1 +- amount."""
    height, width = picture.shape[:2]
    shade = noise(rng, height, width, cell=cell, octaves=7, gain=0.75)
    return to_bytes(picture * (1 + amount * (2 * shade[..., None] - 1)))


def pick(rng: np.random.Generator) -> Rgb:
    """A colour of the palette, a little off."""
    colour = PALETTE[rng.integers(len(PALETTE))]
    return tuple(int(np.clip(c + rng.integers(-18, 19), 0, 255)) for c in colour)


def word(rng: np.random.Generator) -> str:
    """An invented word of two to four syllables."""
    return "".join(rng.choice(SYLLABLES) for _ in range(rng.integers(2, 5)))


def draw_text(draw: ImageDraw.ImageDraw, at: tuple[float, float], text: str, *, size: float, fill: Rgb) -> None:
    """Text with its upper left corner at `at`, in the font that Pillow carries."""
    draw.text(at, text, font=ImageFont.load_default(size), fill=fill)


def draw_column(
    rng: np.random.Generator,
    draw: ImageDraw.ImageDraw,
    *,
    box: tuple[float, float, float, float],
    size: float,
) -> None:
    """Ragged lines of invented words that fill the box (left, top, right, bottom)."""
    left, top, right, bottom = box
    font = ImageFont.load_default(size)
    y = top
    while y + size < bottom:
        line = word(rng)
        while font.getlength(longer := f"{line} {word(rng)}") < right - left:
            line = longer
        if rng.random() < 0.12:
            line = line[: len(line) // 2]
        draw.text((left, y), line, font=font, fill=INK)
        y += 1.3 * size


def wood(
    rng: np.random.Generator,
    height: int,
    width: int,
    *,
    dark: Rgb,
    light: Rgb,
    num_planks: int,
    length: float = 1.0,
) -> np.ndarray:
    """Planks side by side with grain along x, year rings, pores, knots and dark joints.

    `length` is the mean length of a plank as a share of the width; at 1 the planks run through.
    """
    picture = np.zeros((height, width, 3))
    rows = np.linspace(0, height, num_planks + 1).astype(int)
    for top, bottom in itertools.pairwise(rows):
        joints = [0, width]
        if length < 1:
            offset = rng.uniform(0.2, 1) * length
            joints[1:1] = [int(x * width) for x in np.arange(offset, 0.97, length)]
        for left, right in itertools.pairwise(joints):
            size = (bottom - top, right - left)
            grain = noise(rng, *size, cell=size[0] / 2, octaves=6, gain=0.7, stretch=9)
            rings = 0.5 + 0.5 * np.sin(2 * np.pi * rng.uniform(3, 6) * noise(rng, *size, cell=size[0], stretch=5))
            pores = noise(rng, *size, cell=3, octaves=2, stretch=12) > 0.83
            value = 0.5 * grain + 0.35 * rings + rng.uniform(0.0, 0.3) - 0.25 * pores
            plank = ramp(np.clip(value, 0, 1), dark, light)
            plank[: max(1, height // 700)] *= 0.45
            plank[:, : max(1, width // 900)] *= 0.5
            picture[top:bottom, left:right] = plank
    spots = noise(rng, height, width, cell=height / 20, octaves=6, gain=0.8)
    picture *= (0.86 + 0.22 * spots)[..., None]
    # Scratches and stains: short marks that stay put while highlights wander.
    canvas = Image.fromarray(to_bytes(picture))
    draw = ImageDraw.Draw(canvas)
    for _ in range(int(height * width / 7000)):
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        reach = rng.exponential(9)
        angle = rng.normal(0, 0.5)
        shade = dark if rng.random() < 0.7 else light
        draw.line(
            (x, y, x + reach * math.cos(angle), y + reach * math.sin(angle)),
            fill=shade,
            width=int(rng.integers(1, 3)),
        )
    return np.asarray(canvas)


def painting(rng: np.random.Generator, height: int, width: int, *, num_shapes: int = 70) -> np.ndarray:
    """An abstract picture: bands of a noise landscape under polygons, discs, arcs and lines."""
    stops = [pick(rng) for _ in range(6)]
    field = noise(rng, height, width, cell=min(height, width) / 2.5, octaves=6)
    canvas = Image.fromarray(to_bytes(ramp(np.floor(field * 9) / 9, *stops)))
    draw = ImageDraw.Draw(canvas)
    unit = min(height, width)
    for _ in range(num_shapes):
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        reach = unit * float(np.clip(rng.exponential(0.07), 0.012, 0.25))
        colour = pick(rng) if rng.random() < 0.75 else CREAM
        kind = rng.integers(5)
        if kind == 0:
            angles = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 6)))
            draw.polygon([(x + reach * math.cos(a), y + reach * math.sin(a)) for a in angles], fill=colour)
        elif kind == 1:
            draw.ellipse((x - reach, y - reach, x + reach, y + reach), fill=colour)
        elif kind == 2:
            draw.arc(
                (x - reach, y - reach, x + reach, y + reach),
                rng.uniform(0, 180),
                rng.uniform(180, 360),
                fill=colour,
                width=max(2, int(reach / 5)),
            )
        elif kind == 3:
            angle = rng.uniform(0, np.pi)
            dx, dy = 2.5 * reach * math.cos(angle), 2.5 * reach * math.sin(angle)
            draw.line((x - dx, y - dy, x + dx, y + dy), fill=colour, width=max(2, int(reach / 6)))
        else:
            step = max(3.0, reach / 4)
            for i in range(4):
                for j in range(4):
                    if (i + j) % 2:
                        draw.rectangle(
                            (x + i * step, y + j * step, x + (i + 1) * step, y + (j + 1) * step), fill=colour
                        )
    return mottled(rng, np.asarray(canvas), cell=unit / 6, amount=0.18)


def poster(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """A painting on a coloured sheet, with a title above and small print below."""
    background = pick(rng)
    light = sum(background) > 380
    canvas = Image.new("RGB", (width, height), background)
    margin = width // 14
    art_top, art_bottom = int(0.22 * height), int(0.84 * height)
    art = painting(rng, art_bottom - art_top, width - 2 * margin)
    canvas.paste(Image.fromarray(art), (margin, art_top))
    draw = ImageDraw.Draw(canvas)
    fill = INK if light else CREAM
    draw_text(draw, (margin, 0.03 * height), word(rng).upper()[:9], size=width / 7, fill=fill)
    draw_text(
        draw,
        (margin, 0.145 * height),
        f"{word(rng)} {word(rng)} {rng.integers(1890, 2030)}",
        size=width / 16,
        fill=fill,
    )
    for line in range(3):
        text = " ".join(word(rng) for _ in range(6))
        draw_text(draw, (margin, (0.87 + 0.038 * line) * height), text, size=width / 28, fill=fill)
    return mottled(rng, np.asarray(canvas), cell=width / 8, amount=0.1)


def page(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """A page of a magazine: headline, two columns of text, one or two pictures, a coloured box."""
    canvas = Image.new("RGB", (width, height), CREAM)
    draw = ImageDraw.Draw(canvas)
    margin, gutter = width / 13, width / 24
    column = (width - 2 * margin - gutter) / 2
    draw.rectangle((margin, 0.04 * height, width - margin, 0.052 * height), fill=pick(rng))
    draw_text(draw, (margin, 0.06 * height), f"{word(rng)} {word(rng)}".title()[:16], size=width / 9, fill=pick(rng))
    pictures = [(0, 0.19, 0.5), (1, 0.6, 0.93)] if rng.random() < 0.5 else [(1, 0.19, 0.55), (0, 0.62, 0.93)]
    for index in range(2):
        left = margin + index * (column + gutter)
        top, bottom = next((t, b) for i, t, b in pictures if i == index)
        art = painting(rng, int((bottom - top) * height), int(column), num_shapes=25)
        canvas.paste(Image.fromarray(art), (int(left), int(top * height)))
        for start, stop in ((0.19, top - 0.02), (bottom + 0.02, 0.93)):
            if stop - start > 0.1:
                draw_text(draw, (left, start * height), word(rng).title(), size=width / 18, fill=BRICK)
                box = (left, start * height + width / 13, left + column, stop * height)
                draw_column(rng, draw, box=box, size=width / 36)
    draw_text(draw, (width - 1.6 * margin, 0.945 * height), str(rng.integers(10, 99)), size=width / 24, fill=INK)
    return mottled(rng, np.asarray(canvas), cell=width / 4, amount=0.06)


def cover(rng: np.random.Generator, height: int, width: int, *, colour: Rgb) -> np.ndarray:
    """The front of a book: cloth in `colour`, a framed painting, title and author."""
    canvas = Image.new("RGB", (width, height), colour)
    draw = ImageDraw.Draw(canvas)
    fill = INK if sum(colour) > 380 else CREAM
    margin = width // 12
    draw.rectangle(
        (margin // 2, margin // 2, width - margin // 2, height - margin // 2),
        outline=fill,
        width=max(2, width // 120),
    )
    art = painting(rng, int(0.45 * height), width - 3 * margin, num_shapes=35)
    canvas.paste(Image.fromarray(art), (3 * margin // 2, int(0.36 * height)))
    draw_text(draw, (1.4 * margin, 0.07 * height), word(rng).title()[:8], size=width / 6, fill=fill)
    draw_text(draw, (1.4 * margin, 0.19 * height), f"of {word(rng)}"[:11], size=width / 8, fill=fill)
    draw_text(
        draw,
        (1.4 * margin, 0.86 * height),
        f"{word(rng)[0].upper()}. {word(rng).title()}",
        size=width / 14,
        fill=fill,
    )
    return mottled(rng, np.asarray(canvas), cell=width / 6, amount=0.12)


def spine(rng: np.random.Generator, height: int, width: int, *, colour: Rgb) -> np.ndarray:
    """The back of a book, lettering along x: title, bands, a small mark."""
    canvas = Image.new("RGB", (width, height), colour)
    draw = ImageDraw.Draw(canvas)
    fill = INK if sum(colour) > 380 else CREAM
    accent = pick(rng)
    for at in (0.06, 0.1, 0.86, 0.92):
        draw.rectangle((at * width, 0, (at + rng.uniform(0.01, 0.03)) * width, height), fill=accent)
    draw_text(
        draw,
        (0.16 * width, 0.16 * height),
        f"{word(rng)} {word(rng)}".title()[:14],
        size=0.58 * height,
        fill=fill,
    )
    draw.ellipse((0.79 * width, 0.25 * height, 0.79 * width + 0.5 * height, 0.75 * height), fill=accent)
    return mottled(rng, np.asarray(canvas), cell=height / 2, amount=0.14)


def shelf_row(rng: np.random.Generator, height: int, width: int) -> list[tuple[float, float, np.ndarray]]:
    """Books that fill a shelf: (share of the width, share of the height, picture of the spine) of each."""
    books, used = [], 0.0
    while used < 0.97:
        fraction = float(rng.uniform(0.018, 0.05))
        picture = spine(rng, max(int(fraction * width), 16), height, colour=pick(rng) if rng.random() < 0.85 else CREAM)
        books.append((fraction, float(rng.uniform(0.7, 0.97)), np.rot90(picture, 1)))
        used += fraction
    return books


def sheet_map(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """A hiking map: relief colours, contour lines, water, roads and names."""
    relief = noise(rng, height, width, cell=min(height, width) / 2.2, octaves=7, gain=0.5)
    colours = ramp(
        relief,
        (120, 170, 196),
        (156, 198, 208),
        (190, 208, 150),
        (226, 222, 168),
        (222, 190, 136),
        (200, 150, 112),
    )
    level = relief * 24
    gradient = np.hypot(*np.gradient(level)) + 1e-6
    line = np.clip(1.1 - np.abs(level - np.rint(level)) / gradient, 0, 1)[..., None]
    colours = colours * (1 - 0.6 * line) + 0.6 * line * np.array((120, 84, 60))
    canvas = Image.fromarray(to_bytes(colours))
    draw = ImageDraw.Draw(canvas)
    for _ in range(9):
        steps = np.cumsum(rng.normal(0, 0.3, 60))
        angle = rng.uniform(0, 2 * np.pi) + np.convolve(steps, np.ones(8) / 8, mode="same")
        x = rng.uniform(0, width) + np.cumsum(np.cos(angle)) * width / 45
        y = rng.uniform(0, height) + np.cumsum(np.sin(angle)) * width / 45
        points = list(zip(x, y, strict=True))
        draw.line(points, fill=INK, width=7)
        draw.line(points, fill=pick(rng), width=4)
    for _ in range(60):
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        draw.rectangle((x, y, x + rng.uniform(4, 12), y + rng.uniform(4, 12)), fill=INK)
    for _ in range(22):
        at = (rng.uniform(0, 0.9 * width), rng.uniform(0, 0.95 * height))
        draw_text(draw, at, word(rng).title(), size=rng.uniform(14, 40), fill=INK)
    for i in range(1, 6):
        draw.line((i * width / 6, 0, i * width / 6, height), fill=NAVY, width=1)
        draw.line((0, i * height / 6, width, i * height / 6), fill=NAVY, width=1)
    draw.rectangle((0, 0, width - 1, height - 1), outline=CREAM, width=width // 40)
    return np.asarray(canvas)


def globe_map(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Continents in an equirectangular picture, with coast lines, countries and a graticule."""
    base = noise(rng, height, width, cell=height / 2.5, octaves=7, gain=0.5)
    fade = 0.5 - 0.5 * np.cos(np.clip(np.arange(width) / (0.08 * width), 0, 1) * np.pi)
    relief = base * fade + base[:, ::-1] * (1 - fade)
    land = relief > 0.52
    countries = np.floor(noise(rng, height, width, cell=height / 6, octaves=4) * 8) / 8
    sea = ramp(relief / 0.52, (42, 84, 120), (104, 164, 186))
    picture = np.where(land[..., None], ramp(countries, OCHRE, ROSE, CREAM, MOSS, BRICK), sea)
    coast = np.hypot(*np.gradient(land.astype(float))) > 0
    borders = (np.hypot(*np.gradient(countries)) > 0) & land
    picture[coast | borders] = INK
    picture[:: height // 12] *= 0.75
    picture[:, :: width // 24] *= 0.75
    canvas = Image.fromarray(to_bytes(picture))
    draw = ImageDraw.Draw(canvas)
    for _ in range(60):
        at = (rng.uniform(0, 0.95 * width), rng.uniform(0.15, 0.85) * height)
        draw_text(draw, at, word(rng).title(), size=rng.uniform(0.025, 0.05) * height, fill=INK)
    return np.asarray(canvas)


def kilim(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """A woven rug or runner: rows of lozenges, zigzags and stripes, each a little irregular, with threads."""
    canvas = Image.new("RGB", (width, height), CREAM)
    draw = ImageDraw.Draw(canvas)
    x = 0.0
    while x < width:
        band = float(rng.uniform(0.035, 0.1) * width)
        colour, accent = pick(rng), pick(rng)
        draw.rectangle((x, 0, x + band, height), fill=colour)
        kind = rng.integers(4)
        unit = band * rng.uniform(0.7, 1.2)
        for i in range(math.ceil(height / unit) + 1):
            y, size = (i + 0.5) * unit, 0.46 * min(unit, band) * rng.uniform(0.75, 1.0)
            centre = x + band / 2
            mark = accent if rng.random() < 0.75 else pick(rng)
            if kind == 0:
                draw.polygon(
                    [(centre - size, y), (centre, y - size), (centre + size, y), (centre, y + size)],
                    fill=mark,
                )
                draw.polygon(
                    [
                        (centre - size / 2, y),
                        (centre, y - size / 2),
                        (centre + size / 2, y),
                        (centre, y + size / 2),
                    ],
                    fill=pick(rng),
                )
            elif kind == 1:
                draw.polygon([(x, y - unit / 2), (x + band, y), (x, y + unit / 2)], fill=mark)
            elif kind == 2:
                for j in range(4):
                    draw.rectangle(
                        (
                            x + j * band / 4,
                            y - unit / 2 + (j % 2) * unit / 2,
                            x + (j + 1) * band / 4,
                            y + (j % 2) * unit / 2,
                        ),
                        fill=mark if j % 2 else pick(rng),
                    )
            else:
                draw.line((x, y - unit / 2, centre, y, x, y + unit / 2), fill=mark, width=max(2, int(size / 3)))
                draw.ellipse((centre + size / 3, y - size / 3, centre + size, y + size / 3), fill=mark)
        x += band
    picture = np.asarray(canvas).astype(float)
    threads = 1 + 0.07 * np.sin(np.arange(height) * np.pi / 1.5)[:, None] * np.sin(np.arange(width) * np.pi / 2)
    return mottled(rng, picture * threads[..., None], cell=height / 10, amount=0.17)


def bricks(rng: np.random.Generator, height: int, width: int, *, num_rows: int) -> np.ndarray:
    """A wall of painted and bare bricks with rough mortar."""
    brick_height = height / num_rows
    brick_width = 2.6 * brick_height
    mortar = 190 + 40 * noise(rng, height, width, cell=brick_height / 3)
    picture = np.repeat(mortar[..., None], 3, axis=2) * (1.0, 0.96, 0.9)
    grain = noise(rng, height, width, cell=brick_height / 2, octaves=6, gain=0.8)
    wobble = noise(rng, height, width, cell=brick_height / 3, octaves=4)
    rows, columns = np.mgrid[0:height, 0:width].astype(float)
    row_index = np.floor(rows / brick_height).astype(int)
    shifted = columns + (row_index % 2) * brick_width / 2
    column_index = np.floor(shifted / brick_width).astype(int)
    inset = np.minimum(rows % brick_height, brick_height - rows % brick_height)
    inset = np.minimum(inset, np.minimum(shifted % brick_width, brick_width - shifted % brick_width))
    inside = inset > brick_height * (0.04 + 0.07 * wobble)
    table = np.array([(168, 84, 62), (150, 70, 52), (186, 104, 76), (132, 66, 54), (200, 140, 108), (110, 60, 52)])
    choice = rng.integers(len(table), size=(num_rows + 1, int(width / brick_width) + 3))
    light = rng.uniform(0.8, 1.15, size=choice.shape)
    body = table[choice[row_index, column_index]] * light[row_index, column_index][..., None]
    picture = np.where(inside[..., None], body * (0.72 + 0.5 * grain[..., None]), picture)
    return to_bytes(picture)


def wallpaper(rng: np.random.Generator, height: int, width: int, *, ground: Rgb) -> np.ndarray:
    """Scattered leaves, berries and stems on a plain ground; no two alike, so nothing repeats."""
    canvas = Image.new("RGB", (width, height), ground)
    draw = ImageDraw.Draw(canvas)
    unit = height / 22
    for _ in range(int(2.2 * 22 * 22 * width / height)):
        x, y, angle = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(0, 2 * np.pi)
        size = unit * rng.uniform(0.35, 1.3)
        colour = tuple(int(0.6 * c + 0.4 * g) for c, g in zip(pick(rng), ground, strict=True))
        along, across = (
            np.array((math.cos(angle), math.sin(angle))),
            np.array((-math.sin(angle), math.cos(angle))),
        )
        steps = np.linspace(0, 1, 9)
        width_at = 0.28 * np.sin(np.pi * steps**0.8)
        outline = [(x, y) + size * (s * along + w * across) for s, w in zip(steps, width_at, strict=True)]
        outline += [(x, y) + size * (s * along - w * across) for s, w in zip(steps[::-1], width_at[::-1], strict=True)]
        if rng.random() < 0.8:
            draw.polygon([tuple(p) for p in outline], fill=colour)
            tip = np.array((x, y)) + size * along
            draw.line((x, y, *tip), fill=CREAM, width=max(1, int(size / 14)))
        else:
            draw.ellipse((x - size / 5, y - size / 5, x + size / 5, y + size / 5), fill=colour)
    return mottled(rng, np.asarray(canvas), cell=height / 6, amount=0.1)


def stripes(rng: np.random.Generator, height: int, width: int, *, colours: tuple[Rgb, ...]) -> np.ndarray:
    """Glazed bands around a vessel, with dots and brush marks."""
    canvas = Image.new("RGB", (width, height), colours[0])
    draw = ImageDraw.Draw(canvas)
    y = 0.0
    while y < height:
        band = float(rng.uniform(0.05, 0.16) * height)
        colour = colours[rng.integers(len(colours))]
        draw.rectangle((0, y, width, y + band), fill=colour)
        mark = colours[rng.integers(len(colours))]
        pitch = band * rng.uniform(0.7, 1.1)
        for i in range(int(width / pitch)):
            size = 0.36 * band * rng.uniform(0.6, 1)
            centre_x, centre_y = (i + 0.5) * pitch, y + band / 2
            box = (centre_x - size, centre_y - size, centre_x + size, centre_y + size)
            if rng.random() < 0.8:
                draw.ellipse(box, fill=mark)
            else:
                draw.rectangle(box, fill=pick(rng))
        y += band
    return mottled(rng, np.asarray(canvas), cell=height / 6, amount=0.1)


def speckled(rng: np.random.Generator, height: int, width: int, *, dark: Rgb, light: Rgb) -> np.ndarray:
    """Skin of fruit, clay, soil: blotches with fine dots."""
    field = noise(rng, height, width, cell=height / 3, octaves=7, gain=0.75)
    picture = ramp(field, dark, light)
    dots = noise(rng, height, width, cell=5, octaves=1) > 0.86
    picture[dots] = 0.5 * picture[dots] + 0.5 * np.array(CREAM)
    return to_bytes(picture)


def letter_block(rng: np.random.Generator, size: int) -> np.ndarray:
    """A side of a toy block: a letter in a coloured frame on pale wood."""
    canvas = Image.fromarray(wood(rng, size, size, dark=(196, 150, 98), light=(236, 204, 154), num_planks=1))
    draw = ImageDraw.Draw(canvas)
    colour = pick(rng)
    draw.rectangle((size // 16, size // 16, size - size // 16, size - size // 16), outline=colour, width=size // 12)
    letter = str(rng.choice(list("ABCDEFGHKMNPRSTUVWXYZ234578")))
    font = ImageFont.load_default(0.68 * size)
    draw.text((size / 2, size / 2), letter, font=font, fill=colour, anchor="mm")
    return np.asarray(canvas)


def carton(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """A side of a cardboard box: flutes, tape, a printed label."""
    paper = noise(rng, height, width, cell=height / 3, octaves=7, gain=0.8, stretch=3)
    canvas = Image.fromarray(to_bytes(ramp(paper, (146, 106, 66), (196, 156, 106))))
    draw = ImageDraw.Draw(canvas)
    draw.rectangle((0, 0.46 * height, width, 0.54 * height), fill=(206, 182, 134))
    left, top = rng.uniform(0.05, 0.4) * width, rng.uniform(0.06, 0.15) * height
    draw.rectangle((left, top, left + 0.5 * width, top + 0.3 * height), fill=CREAM, outline=INK, width=3)
    draw_column(rng, draw, box=(left + 12, top + 8, left + 0.48 * width, top + 0.28 * height), size=height / 17)
    draw_text(draw, (0.06 * width, 0.6 * height), word(rng).upper()[:8], size=height / 5, fill=pick(rng))
    for i in range(24):
        if rng.random() < 0.6:
            draw.rectangle((0.06 * width + i * 9, 0.86 * height, 0.06 * width + i * 9 + 5, 0.95 * height), fill=INK)
    return np.asarray(canvas)
