"""What stands in the room of the desk scene, and where.

World frame: metres, z up, origin on the floor below the middle of the table. The table-top is at TABLE_HEIGHT and
measures TABLE_SIZE; the room reaches from -ROOM to ROOM.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import desk_geometry as g
import desk_textures as t
import numpy as np

TABLE_HEIGHT = 0.74
TABLE_SIZE = (1.2, 0.8)
ROOM = (2.3, 2.0)
CEILING = 2.6


@dataclass(frozen=True)
class Finish:
    """How a surface looks: a picture (h, w, 3) uint8 sRGB or one colour, with values of the principled shader."""

    paint: np.ndarray | t.Rgb
    roughness: float = 0.6
    metallic: float = 0.0
    coat: float = 0.0
    emission: float = 0.0


@dataclass(frozen=True)
class Part:
    """A mesh in world coordinates with its finish."""

    name: str
    mesh: g.Mesh
    finish: Finish


STEEL = Finish((196, 198, 202), roughness=0.25, metallic=1.0)
BRASS = Finish((214, 164, 88), roughness=0.22, metallic=1.0)
BLACK = Finish((26, 26, 28), roughness=0.45)
WHITE = Finish((226, 222, 214), roughness=0.5)
PAPER_EDGE = Finish((228, 220, 200), roughness=0.9)


def furnish(seed: int) -> list[Part]:
    """All parts of the scene: room, furniture along the walls, table and what lies on it."""
    rng = np.random.default_rng(seed)
    return [*room(rng), *furniture(rng), *table(rng), *table_things(rng)]


def room(rng: np.random.Generator) -> Iterator[Part]:
    """Floor, rug, four walls with skirting, ceiling, window and pictures."""
    x, y = ROOM
    boards = t.wood(rng, 1700, 2000, dark=(112, 74, 44), light=(196, 150, 102), num_planks=26, length=0.3)
    yield Part("floor", g.panel((-x, -y, 0), (2 * x, 0, 0), (0, 2 * y, 0)), Finish(boards, roughness=0.45))
    rug = t.kilim(rng, 1300, 1700)
    yield Part("rug", g.placed(g.box((2.5, 1.9, 0.012)), (0.05, 0.02, 0), turn_deg=4), Finish(rug, roughness=0.95))
    ceiling = g.panel((-x, -y, CEILING), (2 * x, 0, 0), (0, 2 * y, 0))
    yield Part("ceiling", ceiling, Finish((236, 234, 228), roughness=0.9))

    leaves = t.wallpaper(rng, 1400, 2400, ground=(226, 220, 204))
    yield Part("wall north", g.panel((-x, y, 0), (2 * x, 0, 0), (0, 0, CEILING)), Finish(leaves, roughness=0.85))
    brick = t.bricks(rng, 1500, 2300, num_rows=34)
    yield Part("wall east", g.panel((x, y, 0), (0, -2 * y, 0), (0, 0, CEILING)), Finish(brick, roughness=0.9))
    plaster = t.mottled(rng, np.full((1200, 2000, 3), (206, 196, 178), dtype=np.uint8), cell=150, amount=0.16)
    yield Part("wall south", g.panel((x, -y, 0), (-2 * x, 0, 0), (0, 0, CEILING)), Finish(plaster, roughness=0.9))
    sage = t.wallpaper(rng, 1400, 2100, ground=(150, 168, 148))
    yield Part("wall west", g.panel((-x, -y, 0), (0, 2 * y, 0), (0, 0, CEILING)), Finish(sage, roughness=0.85))
    for sign in (-1, 1):
        yield Part("skirting", g.placed(g.box((2 * x, 0.02, 0.1)), (0, sign * (y - 0.01), 0)), WHITE)
        yield Part("skirting", g.placed(g.box((0.02, 2 * y, 0.1)), (sign * (x - 0.01), 0, 0)), WHITE)

    yield from window(rng)
    for at, size in ((-1.55, 0.62), (-0.75, 0.5), (0.12, 0.6), (1.75, 0.55)):
        yield from framed(rng, "north", at, bottom=1.28, size=(size, 1.35 * size))
    for at, bottom, size in ((-1.45, 0.95, 0.52), (-0.8, 0.98, 0.46), (0.95, 0.5, 0.56), (1.6, 0.62, 0.5)):
        yield from framed(rng, "east", at, bottom=bottom, size=(size, 1.35 * size))
    for at, bottom, size in ((-1.5, 0.9, 0.5), (-0.75, 0.42, 0.62), (0.1, 0.5, 0.5), (1.45, 1.05, 0.5)):
        yield from framed(rng, "west", at, bottom=bottom, size=(size, 1.35 * size))
    for at in (-1.75, 1.75):
        yield from framed(rng, "south", at, bottom=0.7, size=(0.5, 0.7))


def on_wall(mesh: g.Mesh, wall: str, at: float, height: float) -> g.Mesh:
    """A mesh made to stand against a wall at its back (+y), moved to position `at` along the wall."""
    x, y = ROOM
    turn_deg, place = {
        "north": (0, (at, y, height)),
        "east": (-90, (x, at, height)),
        "south": (180, (at, -y, height)),
        "west": (90, (-x, at, height)),
    }[wall]
    return g.placed(mesh, place, turn_deg=turn_deg)


def framed(
    rng: np.random.Generator, wall: str, at: float, *, bottom: float, size: tuple[float, float]
) -> Iterator[Part]:
    """A poster in a frame of four slats."""
    width, height = size
    sheet = t.poster(rng, int(1000 * height), int(1000 * width))
    face = g.panel((-width / 2, -0.012, 0), (width, 0, 0), (0, 0, height))
    yield Part("poster", on_wall(face, wall, at, bottom), Finish(sheet, roughness=0.5))
    slat = 0.022
    bars = g.joined(
        g.placed(g.box((width + 2 * slat, 0.03, slat)), (0, -0.015, -slat)),
        g.placed(g.box((width + 2 * slat, 0.03, slat)), (0, -0.015, height)),
        g.placed(g.box((slat, 0.03, height)), (-width / 2 - slat / 2, -0.015, 0)),
        g.placed(g.box((slat, 0.03, height)), (width / 2 + slat / 2, -0.015, 0)),
    )
    finish = (BLACK, Finish((150, 104, 60), roughness=0.4), WHITE)[rng.integers(3)]
    yield Part("frame", on_wall(bars, wall, at, bottom), finish)


def window(rng: np.random.Generator) -> Iterator[Part]:
    """The window in the south wall: a bright view, bars, sill, radiator and two curtains."""
    sky = t.noise(rng, 500, 700, cell=160)
    view = t.ramp(sky, (206, 222, 240), (250, 250, 250))
    hills = 330 + 90 * t.noise(rng, 1, 700, cell=260, stretch=0.5)[0]
    trees = t.ramp(t.noise(rng, 500, 700, cell=50, octaves=7, gain=0.7), (52, 78, 40), (128, 156, 88), (196, 204, 140))
    ground = np.arange(500)[:, None] > hills
    view[ground] = trees[ground]
    pane = g.panel((-0.75, -0.004, 0), (1.5, 0, 0), (0, 0, 1.25))
    yield Part("window view", on_wall(pane, "south", 0, 0.95), Finish(t.to_bytes(view), emission=0.95))
    bars = [g.placed(g.box((0.05, 0.054, 1.3)), (x, -0.027, -0.02)) for x in (-0.77, 0, 0.77)]
    bars += [g.placed(g.box((1.6, 0.06, 0.05)), (0, -0.03, z)) for z in (-0.03, 0.75, 1.24)]
    bars.append(g.placed(g.box((1.75, 0.2, 0.03)), (0, -0.1, -0.06)))
    yield Part("window frame", on_wall(g.joined(*bars), "south", 0, 0.95), WHITE)
    ribs = [g.placed(g.box((0.055, 0.09, 0.6)), (x, -0.08, 0.12)) for x in np.arange(-0.65, 0.66, 0.075)]
    yield Part("radiator", on_wall(g.joined(*ribs), "south", 0, 0), WHITE)
    cloth = t.kilim(rng, 1400, 700)
    for side in (-1, 1):
        u, v = np.meshgrid(np.linspace(0, 1, 90), np.linspace(0, 1, 24))
        depth = -0.11 + 0.045 * np.sin(2 * np.pi * 6 * u + 0.8 * np.sin(3 * v)) * (1.1 - 0.4 * v)
        curtain = np.stack((side * 0.98 + 0.4 * (u - 0.5), depth, 0.35 + 2.0 * v), axis=-1)
        yield Part("curtain", on_wall(g.sheet(curtain), "south", 0, 0), Finish(cloth, roughness=0.95))


def furniture(rng: np.random.Generator) -> Iterator[Part]:
    """A bookcase, a sideboard, cartons, a floor lamp, a chest and a tall plant, all along the walls."""
    yield from bookcase(rng, "north", -0.72, size=(2.0, 0.3, 1.16), num_rows=3)
    yield from bookcase(rng, "east", -0.9, size=(1.25, 0.3, 0.86), num_rows=2)
    yield from carton_pile(rng, (1.62, 1.6))
    yield from carton_pile(rng, (-1.85, -1.55))
    oak = t.wood(rng, 500, 1200, dark=(92, 58, 34), light=(176, 124, 78), num_planks=4)
    chest = g.box((1.3, 0.42, 0.4))
    yield Part("chest", on_wall(g.placed(chest, (0, -0.23, 0)), "west", -0.35, 0), Finish(oak, roughness=0.5))
    for index, at in enumerate((-0.75, -0.4, -0.05, 0.15)):
        pile = [
            g.placed(g.box((0.24, 0.3, 0.03)), (0, 0, 0.03 * i), turn_deg=float(rng.normal(0, 9))) for i in range(4)
        ]
        sides = [(t.cover(rng, 500, 380, colour=t.pick(rng)), mesh) for mesh in pile]
        for picture, mesh in sides[: 2 + index % 3]:
            yield Part("magazine", g.placed(mesh, (-2.06, at, 0.4)), Finish(picture, roughness=0.4))

    pole = [
        g.rod((0, 0, 0.02), (0, 0, 1.6), 0.011),
        g.placed(g.lathe([(0, 0), (0.15, 0), (0.15, 0.02), (0, 0.03)]), (0, 0, 0)),
    ]
    yield Part("floor lamp", g.placed(g.joined(*pole), (2.0, 0.3, 0)), BRASS)
    shade = t.mottled(rng, np.full((200, 500, 3), (232, 214, 176), dtype=np.uint8), cell=60, amount=0.1)
    cone = g.lathe([(0.2, 1.42), (0.13, 1.72)])
    yield Part("lamp shade", g.placed(cone, (2.0, 0.3, 0)), Finish(shade, emission=0.9))

    pot = g.lathe(g.rounded([(0, 0), (0.13, 0.0), (0.17, 0.28), (0.15, 0.29), (0.14, 0.25), (0, 0.25)]))
    glaze = t.stripes(rng, 300, 900, colours=(t.CREAM, t.TEAL, t.BRICK))
    yield Part("floor pot", g.placed(pot, (1.75, -1.6, 0)), Finish(glaze, roughness=0.3))
    yield from greenery(rng, (1.75, -1.6, 0.25), num_stems=16, height=0.85, leaf=0.26)


def bookcase(
    rng: np.random.Generator, wall: str, at: float, *, size: tuple[float, float, float], num_rows: int
) -> Iterator[Part]:
    """Shelves filled with books, and a few things on top."""
    width, depth, height = size
    boards_picture = t.wood(rng, 300, 1500, dark=(120, 84, 52), light=(206, 164, 114), num_planks=2)
    wooden = Finish(boards_picture, roughness=0.5)
    thick = 0.022
    boards = [
        g.placed(g.box((width - thick, depth - 0.006, thick)), (0, -depth / 2, z))
        for z in np.linspace(0.05, height, num_rows + 1)
    ]
    boards += [g.placed(g.box((thick, depth, height)), (side * width / 2, -depth / 2, 0.0)) for side in (-1, 1)]
    boards.append(g.placed(g.box((width, 0.01, height)), (0, -0.006, 0)))
    yield Part("bookcase", on_wall(g.joined(*boards), wall, at, 0), wooden)
    shelf = (height - 0.05) / num_rows - thick
    for row in range(num_rows):
        bottom = 0.05 + thick + row * (shelf + thick)
        x = -width / 2 + 0.02
        for fraction, tall, picture in t.shelf_row(rng, int(1500 * shelf), int(1500 * width)):
            thickness = fraction * (width - 0.05)
            x += thickness / 2
            reach = depth * float(rng.uniform(0.72, 0.92))
            book = g.placed(g.box((thickness * 0.96, reach, shelf * tall)), (x, -0.02 - reach / 2, bottom))
            yield Part("shelf book", on_wall(book, wall, at, 0), Finish(picture, roughness=0.55))
            x += thickness / 2
    top = height + thick
    for x in np.linspace(-0.4 * width, 0.4 * width, 4):
        kind = rng.integers(3)
        if kind == 0:
            vase = g.lathe(g.rounded([(0, 0), (0.05, 0), (0.085, 0.1), (0.04, 0.2), (0.055, 0.25), (0.03, 0.2)]))
            finish = Finish(t.stripes(rng, 300, 700, colours=(t.pick(rng), t.CREAM, t.pick(rng))), roughness=0.25)
            yield Part("vase", on_wall(g.placed(vase, (x, -0.16, top)), wall, at, 0), finish)
        elif kind == 1:
            mesh = g.placed(g.box((0.24, 0.2, 0.16)), (x, -0.15, top), turn_deg=float(rng.normal(0, 8)))
            yield Part("small box", on_wall(mesh, wall, at, 0), Finish(t.carton(rng, 300, 400), roughness=0.8))
        else:
            for layer in range(4):
                mesh = g.placed(
                    g.box((0.26, 0.2, 0.035)), (x, -0.15, top + 0.035 * layer), turn_deg=float(rng.normal(0, 6))
                )
                picture = t.spine(rng, 60, 420, colour=t.pick(rng))
                yield Part("lying book", on_wall(mesh, wall, at, 0), Finish(picture, roughness=0.5))


def carton_pile(rng: np.random.Generator, at: tuple[float, float]) -> Iterator[Part]:
    """Three cardboard boxes, the third on top of the others."""
    for dx, dy, z, size in (
        (0, 0, 0, (0.5, 0.4, 0.34)),
        (0.1, -0.42, 0, (0.4, 0.36, 0.3)),
        (0.03, -0.05, 0.34, (0.36, 0.32, 0.26)),
    ):
        for mesh in g.box_sides(size).values():
            placed = g.placed(mesh, (at[0] + dx, at[1] + dy * math.copysign(1, at[1]), z), turn_deg=17 + 40 * z)
            yield Part("carton", placed, Finish(t.carton(rng, 360, 520), roughness=0.85))


def table(rng: np.random.Generator) -> Iterator[Part]:
    """A wooden table with four legs and a runner that hangs over both ends."""
    x, y = TABLE_SIZE
    top = t.wood(rng, 1100, 1650, dark=(104, 62, 34), light=(204, 144, 92), num_planks=6)
    finish = Finish(top, roughness=0.35, coat=0.15)
    yield Part("table top", g.placed(g.box((x, y, 0.03)), (0, 0, TABLE_HEIGHT - 0.03)), finish)
    legs = [
        g.placed(g.box((0.055, 0.055, TABLE_HEIGHT - 0.03)), (sx * 0.54, sy * 0.34, 0))
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    legs += [g.placed(g.box((1.05, 0.02, 0.08)), (0, sy * 0.34, TABLE_HEIGHT - 0.11)) for sy in (-1, 1)]
    yield Part("table legs", g.joined(*legs), Finish(top[:200], roughness=0.4))

    edge = x / 2 + 0.004
    line = [(-edge, -0.12), (-edge, -0.03), (-edge + 0.001, -0.002), (-edge + 0.006, 0.003)]
    line += [(s, 0.003) for s in np.linspace(-0.58, 0.58, 40)]
    line += [(-a, b) for a, b in line[3::-1]]
    profile = np.array(line)
    across = np.linspace(-0.15, 0.15, 24)
    grid = np.stack(
        (
            np.broadcast_to(profile[:, 0], (24, len(line))),
            np.broadcast_to(across[:, None], (24, len(line))),
            np.broadcast_to(profile[:, 1], (24, len(line))),
        ),
        axis=-1,
    ).copy()
    inner = np.abs(profile[:, 0]) < 0.57
    ripples = t.noise(rng, 24, int(inner.sum()), cell=7, octaves=2)
    grid[:, inner, 2] += 0.004 * ripples
    cloth = Finish(t.kilim(rng, 420, 1900), roughness=0.95)
    yield Part("runner", g.placed(g.sheet(grid), (0, 0.05, TABLE_HEIGHT)), cloth)


def table_things(rng: np.random.Generator) -> Iterator[Part]:
    """Everything on the table-top; heights clear the runner where they stand on it."""
    wood_z, cloth_z = TABLE_HEIGHT, TABLE_HEIGHT + 0.006
    yield from book_pile(rng, (-0.36, 0.21, cloth_z))
    yield from magazine(rng, (-0.17, -0.26, wood_z), turn_deg=-9)
    picture = t.sheet_map(rng, 900, 900)
    yield Part(
        "map", g.placed(g.box((0.4, 0.4, 0.0012)), (0.33, 0.2, cloth_z), turn_deg=-14), Finish(picture, roughness=0.6)
    )
    yield from teapot((0.04, 0.07, cloth_z), turn_deg=205)
    yield from mug(rng, (0.21, -0.1, wood_z + 0.001), turn_deg=-60)
    yield from fruit_bowl(rng, (0.42, 0.19, cloth_z + 0.002))
    yield from flower_pot(rng, (-0.03, 0.29, wood_z))
    yield from globe(rng, (-0.46, -0.04, cloth_z))
    yield from pencil_cup(rng, (0.5, -0.1, wood_z))
    yield from wire_bicycle((0.33, -0.28, wood_z), turn_deg=24)
    for x, y, z, turn in (
        (0.1, -0.27, 0, 20),
        (0.145, -0.3, 0, -12),
        (0.12, -0.28, 0.038, 44),
        (-0.2, 0.07, 0.006, 30),
    ):
        for mesh in g.box_sides((0.038, 0.038, 0.038)).values():
            finish = Finish(t.letter_block(rng, 160), roughness=0.5)
            yield Part("toy block", g.placed(mesh, (x, y, wood_z + z), turn_deg=turn), finish)
    cards = (
        (0.52, 0.02, 6, 70),
        (0.47, -0.34, 0, 8),
        (-0.5, -0.31, 0, 96),
        (-0.45, -0.2, 1.5, 130),
        (0.16, 0.33, 0, 15),
    )
    for x, y, lift_mm, turn in cards:
        card = g.placed(g.box((0.14, 0.095, 0.001)), (x, y, wood_z + 0.001 * lift_mm), turn_deg=turn)
        yield Part("postcard", card, Finish(t.painting(rng, 285, 420, num_shapes=40), roughness=0.4))
    coin = g.lathe([(0, 0), (0.012, 0), (0.012, 0.002), (0, 0.002)])
    for x, y in ((0.29, -0.02), (0.32, -0.04), (-0.09, -0.06)):
        yield Part("coin", g.placed(coin, (x, y, cloth_z)), BRASS)


def book_pile(rng: np.random.Generator, at: tuple[float, float, float]) -> Iterator[Part]:
    """Four hard-cover books on one another: block of pages, two boards and a spine each."""
    z = at[2]
    books = (((0.25, 0.19, 0.034), t.TEAL, 12), ((0.23, 0.17, 0.028), t.OCHRE, -4), ((0.215, 0.15, 0.024), t.BRICK, 22))
    for (width, depth, height), colour, turn in books:
        place = (at[0], at[1], z)
        pages = g.placed(g.box((width - 0.012, depth - 0.01, height - 0.006)), (0, 0.003, 0.003))
        lines = np.repeat(rng.integers(190, 240, (40, 1, 3)), 8, axis=1).astype(np.uint8)
        yield Part("pages", g.placed(pages, place, turn_deg=turn), Finish(lines, roughness=0.9))
        front = np.rot90(t.cover(rng, 760, 600, colour=colour), 1)
        board = g.box((width, depth, 0.003))
        yield Part("board", g.placed(board, place, turn_deg=turn), Finish(colour, roughness=0.6))
        lid = g.placed(board, (0, 0, height - 0.003))
        yield Part("cover", g.placed(lid, place, turn_deg=turn), Finish(front, roughness=0.35, coat=0.2))
        back = g.placed(g.box((width, 0.003, height)), (0, -depth / 2, 0))
        yield Part(
            "spine", g.placed(back, place, turn_deg=turn), Finish(t.spine(rng, 110, 800, colour=colour), roughness=0.5)
        )
        z += height + 0.0005
    knot_at = (at[0] - 0.01, at[1], z)
    angle = np.linspace(0, 2 * np.pi, 200)
    radius = 0.032 * (1 + 0.42 * np.cos(3 * angle))
    path = np.stack(
        (radius * np.cos(2 * angle), radius * np.sin(2 * angle), 0.024 + 0.0155 * np.sin(3 * angle)), axis=1
    )
    yield Part("brass knot", g.placed(g.tube(path, 0.0085, sides=20), knot_at, turn_deg=15), BRASS)


def magazine(rng: np.random.Generator, at: tuple[float, float, float], *, turn_deg: float) -> Iterator[Part]:
    """An open magazine, its pages bent up towards the fold."""
    width, height = 0.2, 0.265
    s = np.linspace(0, 1, 30)
    lift = 0.0015 + 0.016 * np.exp(-3.2 * s) * (1 - np.exp(-14 * s))
    for side in (-1, 1):
        x = np.sort(side * s * width)
        z = lift if side > 0 else lift[::-1]
        grid = np.stack(
            (np.tile(x, (2, 1)), np.repeat([[-height / 2], [height / 2]], 30, axis=1), np.tile(z, (2, 1))), -1
        )
        picture = t.page(rng, 1060, 800)
        yield Part("page", g.placed(g.sheet(grid), at, turn_deg=turn_deg), Finish(picture, roughness=0.35, coat=0.25))
    rim = g.box((2 * width, height, 0.0012))
    yield Part("page block", g.placed(rim, at, turn_deg=turn_deg), PAPER_EDGE)


def teapot(at: tuple[float, float, float], *, turn_deg: float) -> Iterator[Part]:
    """The glossy object: a glazed pot with lid, spout and handle."""
    glaze = Finish((16, 92, 104), roughness=0.07, coat=1.0)
    body = g.rounded([(0, 0), (0.045, 0), (0.07, 0.02), (0.084, 0.06), (0.072, 0.1), (0.045, 0.122), (0.04, 0.126)])
    lid = g.rounded(
        [
            (0.045, 0.125),
            (0.04, 0.133),
            (0.02, 0.141),
            (0.007, 0.145),
            (0.006, 0.15),
            (0.013, 0.157),
            (0.011, 0.166),
            (0, 0.169),
        ]
    )
    spout = g.smooth_path([(0.066, 0, 0.045), (0.1, 0, 0.058), (0.118, 0, 0.09), (0.145, 0, 0.116)])
    handle = g.smooth_path(
        [(-0.062, 0, 0.106), (-0.1, 0, 0.118), (-0.13, 0, 0.09), (-0.118, 0, 0.05), (-0.074, 0, 0.032)]
    )
    whole = g.joined(
        g.lathe(body, segments=96),
        g.lathe(lid, segments=96),
        g.tube(spout, np.linspace(0.023, 0.0105, len(spout)), sides=24),
        g.tube(handle, 0.0085, sides=20),
    )
    yield Part("teapot", g.placed(whole, at, turn_deg=turn_deg), glaze)


def mug(rng: np.random.Generator, at: tuple[float, float, float], *, turn_deg: float) -> Iterator[Part]:
    """A painted mug with tea in it."""
    outside = g.lathe(g.rounded([(0.0, 0.0), (0.034, 0), (0.039, 0.012), (0.041, 0.05), (0.0415, 0.094)]))
    inside = g.lathe([(0.0415, 0.094), (0.0405, 0.096), (0.038, 0.094), (0.0375, 0.05), (0.03, 0.01), (0, 0.008)])
    handle = g.smooth_path([(0.04, 0, 0.078), (0.062, 0, 0.08), (0.073, 0, 0.055), (0.06, 0, 0.026), (0.039, 0, 0.022)])
    pattern = t.stripes(rng, 420, 1100, colours=(t.CREAM, t.BRICK, t.NAVY, t.OCHRE))
    yield Part("mug", g.placed(outside, at, turn_deg=turn_deg), Finish(pattern, roughness=0.2, coat=0.4))
    white = Finish(t.CREAM, roughness=0.2, coat=0.4)
    yield Part("mug inside", g.placed(g.joined(inside, g.tube(handle, 0.006, sides=16)), at, turn_deg=turn_deg), white)
    tea = g.lathe([(0.0378, 0.078), (0, 0.0781)])
    yield Part("tea", g.placed(tea, at), Finish((92, 40, 14), roughness=0.08))


def fruit_bowl(rng: np.random.Generator, at: tuple[float, float, float]) -> Iterator[Part]:
    """A patterned bowl with oranges, apples and a lemon."""
    profile = [
        (0, 0.004),
        (0.045, 0.0),
        (0.05, 0.006),
        (0.09, 0.03),
        (0.115, 0.062),
        (0.117, 0.064),
        (0.112, 0.063),
        (0.085, 0.034),
        (0, 0.014),
    ]
    pattern = t.stripes(rng, 500, 1400, colours=(t.CREAM, t.TEAL, t.SKY, t.NAVY))
    yield Part("bowl", g.placed(g.lathe(profile, segments=72), at), Finish(pattern, roughness=0.25, coat=0.4))
    orange, apple, lemon = (
        ((214, 104, 20), (246, 164, 50)),
        ((132, 22, 20), (206, 150, 62)),
        ((214, 176, 40), (250, 224, 96)),
    )
    fruits = (
        (-0.045, -0.03, 0.052, 0.037, orange),
        (0.045, -0.02, 0.05, 0.036, apple),
        (0.0, 0.048, 0.05, 0.036, orange),
        (0.005, -0.002, 0.1, 0.034, apple),
        (-0.05, 0.04, 0.078, 0.026, lemon),
    )
    for x, y, z, radius, (dark, light) in fruits:
        skin = Finish(t.speckled(rng, 240, 480, dark=dark, light=light), roughness=0.35)
        mesh = g.placed(g.ball(radius), (at[0] + x, at[1] + y, at[2] + z), turn_deg=90 * x / radius, tilt_deg=25)
        yield Part("fruit", mesh, skin)
        stalk = g.rod(
            (at[0] + x, at[1] + y, at[2] + z + radius - 0.003),
            (at[0] + x + 0.004, at[1] + y, at[2] + z + radius + 0.009),
            0.0013,
        )
        yield Part("stalk", stalk, Finish((70, 50, 28)))


def flower_pot(rng: np.random.Generator, at: tuple[float, float, float]) -> Iterator[Part]:
    """A clay pot with a plant on thin stems."""
    profile = [
        (0, 0),
        (0.036, 0),
        (0.05, 0.062),
        (0.056, 0.062),
        (0.057, 0.08),
        (0.052, 0.08),
        (0.047, 0.066),
        (0, 0.066),
    ]
    clay = t.speckled(rng, 300, 900, dark=(148, 74, 44), light=(206, 124, 82))
    yield Part("clay pot", g.placed(g.lathe(profile), at), Finish(clay, roughness=0.85))
    yield from greenery(rng, (at[0], at[1], at[2] + 0.066), num_stems=15, height=0.2, leaf=0.07)


def greenery(
    rng: np.random.Generator, at: tuple[float, float, float], *, num_stems: int, height: float, leaf: float
) -> Iterator[Part]:
    """Bent stems from one place, each with a pointed, folded leaf at its end and one on its way."""
    stems, leaves = [], []
    for index in range(num_stems):
        angle = 2.4 * index + rng.normal(0, 0.2)
        lean = rng.uniform(0.15, 0.75)
        tall = height * rng.uniform(0.6, 1.05)
        out = np.array((math.cos(angle), math.sin(angle), 0))
        up = np.array((0, 0, 1.0))
        points = [0.06 * height * out, 0.35 * lean * tall * out + 0.6 * tall * up, lean * tall * out + tall * up]
        path = g.smooth_path([tuple(p) for p in points], steps=8)
        stems.append(g.tube(path, np.linspace(0.010, 0.006, len(path)) * height, sides=6))
        for step, size in ((-1, leaf), (len(path) // 2, 0.7 * leaf)):
            heading = out * math.cos(0.5) + rng.normal(0, 0.35, 3)
            heading = heading / np.linalg.norm(heading)
            across = np.cross(heading, up)
            across /= np.linalg.norm(across)
            s, w = np.meshgrid(np.linspace(0, 1, 9), (-1, -0.5, 0, 0.5, 1), indexing="ij")
            half = 0.27 * np.sin(np.pi * s**0.75)
            droop = 0.25 * s - 0.55 * s**2
            blade = s[..., None] * heading + (half * w)[..., None] * across
            blade = blade + (droop + 0.25 * half * np.abs(w))[..., None] * up
            leaves.append(g.sheet(path[step] + size * blade))
    yield Part("stems", g.placed(g.joined(*stems), at), Finish((74, 96, 40), roughness=0.6))
    vein = t.noise(rng, 160, 160, cell=40, octaves=6)
    picture = t.ramp(vein, (40, 78, 34), (120, 158, 66))
    picture[:, 76:84] = (176, 196, 120)
    picture[::12] = 0.8 * picture[::12] + 0.2 * np.array((190, 206, 130))
    yield Part("leaves", g.placed(g.joined(*leaves), at), Finish(np.rot90(t.to_bytes(picture)), roughness=0.4))


def globe(rng: np.random.Generator, at: tuple[float, float, float]) -> Iterator[Part]:
    """A globe on a brass foot with a half meridian."""
    radius, centre = 0.078, (at[0], at[1], at[2] + 0.125)
    picture = t.globe_map(rng, 700, 1400)
    yield Part(
        "globe", g.placed(g.ball(radius, segments=72), centre, tilt_deg=23), Finish(picture, roughness=0.3, coat=0.2)
    )
    angle = np.linspace(-np.pi / 2, np.pi / 2, 40)
    arc = np.stack((0 * angle, (radius + 0.01) * np.cos(angle), (radius + 0.01) * np.sin(angle)), axis=1)
    meridian = g.placed(g.tube(arc, 0.0028, sides=10), centre, tilt_deg=23)
    foot = g.lathe(g.rounded([(0, 0), (0.055, 0), (0.055, 0.006), (0.012, 0.014), (0.006, 0.03), (0.006, 0.046)]))
    yield Part("globe stand", g.joined(meridian, g.placed(foot, at)), BRASS)


def pencil_cup(rng: np.random.Generator, at: tuple[float, float, float]) -> Iterator[Part]:
    """A cup of coloured pencils."""
    wall = [(0, 0), (0.036, 0), (0.037, 0.095), (0.034, 0.095), (0.033, 0.004), (0, 0.004)]
    pattern = t.painting(rng, 500, 1200, num_shapes=120)
    yield Part("cup", g.placed(g.lathe(wall), at), Finish(pattern, roughness=0.4))
    for index in range(9):
        angle = 2.4 * index
        foot = np.array((0.014 * math.cos(angle + 2.6), 0.014 * math.sin(angle + 2.6), 0.006))
        rim = np.array((0.029 * math.cos(angle), 0.029 * math.sin(angle), 0.096))
        axis = (rim - foot) / np.linalg.norm(rim - foot)
        length = rng.uniform(0.14, 0.175)
        shaft, cone = foot + axis * (length - 0.016), foot + axis * length
        pencil = g.rod(foot + at, shaft + at, 0.0037, sides=6)
        yield Part("pencil", pencil, Finish(t.pick(rng), roughness=0.35))
        wood_end = g.tube(np.array((shaft, 0.7 * cone + 0.3 * shaft)) + at, np.array((0.0037, 0.0014)), sides=6)
        yield Part("pencil wood", wood_end, Finish((222, 184, 134)))
        yield Part(
            "pencil tip",
            g.tube(np.array((0.7 * cone + 0.3 * shaft, cone)) + at, np.array((0.0014, 0.0002)), sides=6),
            BLACK,
        )


def wire_bicycle(at: tuple[float, float, float], *, turn_deg: float) -> Iterator[Part]:
    """The thin structure: a bicycle bent from wire, spokes 2 mm thick and a frame of 4 mm once scaled."""
    radius, thin, thick = 0.045, 0.0008, 0.0016
    rear, front = np.array((-0.062, 0, radius)), np.array((0.062, 0, radius))
    angle = np.linspace(0, 2 * np.pi, 61)
    wires = []
    for hub in (rear, front):
        rim = hub + radius * np.stack((np.cos(angle), 0 * angle, np.sin(angle)), axis=1)
        wires.append(g.tube(rim, thick, sides=10))
        for a in np.linspace(0, 2 * np.pi, 12, endpoint=False):
            end = hub + radius * np.array((math.cos(a), 0, math.sin(a)))
            wires.append(g.rod(tuple(hub), tuple(end), thin, sides=8))
    crank, saddle, head = (-0.008, 0, 0.04), (-0.03, 0, 0.115), (0.045, 0, 0.105)
    lines = [(tuple(rear), crank), (tuple(rear), (-0.026, 0, 0.1)), (crank, saddle), (crank, (0.048, 0, 0.095))]
    lines += [((-0.026, 0, 0.1), head), (tuple(front), (0.04, 0, 0.12)), ((-0.048, 0, 0.117), (-0.012, 0, 0.114))]
    wires += [g.rod(a, b, thick, sides=10) for a, b in lines]
    bar = g.smooth_path(
        [(0.03, -0.032, 0.122), (0.04, -0.02, 0.124), (0.04, 0, 0.12), (0.04, 0.02, 0.124), (0.03, 0.032, 0.122)]
    )
    wires.append(g.tube(bar, thick, sides=10))
    yield Part(
        "wire bicycle",
        g.placed(g.joined(*wires), at, turn_deg=turn_deg, scale=1.25),
        Finish((190, 40, 32), roughness=0.35),
    )
