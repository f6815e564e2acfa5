"""Draw which room of thermorender imports which: docs/architecture.svg, read from the code's own imports.

`python docs/architecture.py` writes the drawing; the tests read the same rooms, order and imports from here. Modules
are parsed, not imported, and imports inside functions count like any others.
"""

import ast
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "thermorender"
DRAWING = Path(__file__).with_name("architecture.svg")
# From the ground up, with what each room holds: a room imports only from itself and from those before it.
ROOMS = {
    "ground": "errors, units, defaults, paths, versions, files, formats, cache, schema, progress, timing",
    "physics": "Planck's law, bands, emission, Fresnel, surfaces, sun, heat, geodesy: NumPy only",
    "atmosphere": "air: model, rays, profile, standard table, MODTRAN, LOWTRAN7's aerosols",
    "weather": "a station's, a typical year's or a named day's: missing values are modelled, wrong ones refused",
    "materials": "one material, the library, mixtures, files; import, check, compare, plot",
    "trajectory": "flight logs to timed poses",
    "sensor": "radiance to counts to picture",
    "footage": "files of real cameras: readers, statistics, calibration",
    "learned": "RGB to temperature, RGB to material",
    "scene": "the user's description: specification, terrain, mesh, objects, temperature sources",
    "synthetic": "worlds from a seed",
    "frame": "the Frame: a value; its picture, files and map",
    "render": "the only importer of Mitsuba and Dr.Jit: bake, trace, budget, truth, reference",
    "output": "images, video, records, flights",
    "campaign": "data sets for learned maps",
    "inverse": "from frames back to the scene: forward model, normal equations, poses, uncertainty, files",
    "compare": "learned translation against the render, maps on a data set, the cost of a frame, the self-test",
    "link": "frames to a simulator over a socket: protocol, server, sessions, client",
    "cluster": "flights by the workers of Dask: connecting, what they are sent, what comes back",
    "studio": "materials edited in the browser: session, page, frames in the background",
    "cli": "every command, and code that commands share",
}
GROUND = {name.strip() for name in ROOMS["ground"].split(",")}
# The package's own front, which hands out the public names.
FRONT = {"__init__", "__main__"}


def room_of(module):
    """Return the room of a dotted module name inside the package, such as "render.plan"; None for the front."""
    first = module.split(".")[0]
    return "ground" if first in GROUND else None if first in FRONT or not first else first


def modules():
    """Return {dotted name inside the package: path} of all modules."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        found[".".join(parts[:-1] if len(parts) > 1 and parts[-1] == "__init__" else parts)] = path
    return found


def imports(path, typing=True):
    """Return the set of dotted names that a file imports, `from a import b` as both a and a.b.

    Without `typing`, imports under `if TYPE_CHECKING:`, which never run, are left out.
    """
    found, tree = set(), ast.parse(path.read_text(encoding="utf-8"))
    skipped = set()
    if not typing:
        for node in ast.walk(tree):
            if isinstance(node, ast.If) and getattr(node.test, "id", None) == "TYPE_CHECKING":
                skipped |= {id(each) for part in node.body for each in ast.walk(part)}
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                raise ValueError(f"{path}: a relative import; name the module from thermorender on")
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def own_imports(typing=True):
    """Return {module: set of the package's modules it imports}, dotted names inside the package; see `imports`."""
    known = modules()
    found = {}
    for module, path in known.items():
        names = {
            name.removeprefix("thermorender.") for name in imports(path, typing) if name.startswith("thermorender.")
        }
        found[module] = (names & set(known)) - {module}
    return found


def room_imports():
    """Return {(importing room, imported room): number of modules that do}."""
    count = {}
    for module, imported in own_imports().items():
        here = room_of(module)
        for there in {room_of(name) for name in imported} - {here, None}:
            if here is not None:
                count[here, there] = count.get((here, there), 0) + 1
    return count


def circles():
    """Return the groups of modules that import each other in a circle when they run, each a sorted list."""
    graph, index, low, stack, found = own_imports(typing=False), {}, {}, [], []

    def visit(module):
        index[module] = low[module] = len(index)
        stack.append(module)
        for other in sorted(graph[module]):
            if other not in index:
                visit(other)
            if other in stack:
                low[module] = min(low[module], low[other])
        if low[module] == index[module]:
            group = stack[stack.index(module) :]
            del stack[len(stack) - len(group) :]
            if len(group) > 1:
                found.append(sorted(group))

    for module in graph:
        if module not in index:
            visit(module)
    return found


def drawing():
    """Return the import graph as SVG: rooms from the ground up, an arc from each importing room to what it imports."""
    order, step, top, left, width = list(ROOMS), 46, 30, 20, 560
    middle = {room: top + (len(order) - 1 - number) * step + 16 for number, room in enumerate(order)}
    height = top + len(order) * step + 10
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="1000" height="{height}" font-family="sans-serif">',
        f'<rect width="1000" height="{height}" fill="white"/>',
    ]
    for (here, there), count in sorted(room_imports().items()):
        upward = order.index(there) >= order.index(here)
        start, end = middle[here] + 4, middle[there] - 4
        edge, colour = left + width, "#d62728" if upward else "#1f77b4"
        bulge = edge + 30 + 22 * abs(order.index(here) - order.index(there))
        lines += [
            f'<path d="M {edge} {start} C {bulge} {start}, {bulge} {end}, {edge + 6} {end}" fill="none" '
            f'stroke="{colour}" stroke-opacity="0.55" stroke-width="{1 + 0.5 * count**0.5:.1f}">',
            f"<title>{here} imports {there}: {count} modules</title></path>",
            f'<path d="M {edge + 7} {end - 4} l -7 4 l 7 4 z" fill="{colour}"/>',
        ]
    for room, what in ROOMS.items():
        y = middle[room]
        files = sum(1 for module in modules() if room_of(module) == room)
        lines += [
            f'<rect x="{left}" y="{y - 17}" width="{width}" height="34" rx="5" fill="#f2f5f8" stroke="#8899aa"/>',
            f'<text x="{left + 10}" y="{y - 2}" font-size="14" font-weight="bold">{room}</text>',
            f'<text x="{left + width - 10}" y="{y - 2}" font-size="11" text-anchor="end">{files} modules</text>',
            f'<text x="{left + 10}" y="{y + 12}" font-size="11" fill="#333">{what}</text>',
        ]
    return "\n".join([*lines, "</svg>"]) + "\n"


if __name__ == "__main__":
    DRAWING.write_text(drawing(), encoding="utf-8")
    print(DRAWING)
