"""Draw which room of thermorender imports which: docs/architecture.svg, read from the code's own imports.

`python docs/architecture.py` writes the drawing; the tests read the same rooms, order and imports from here. Modules
are parsed, not imported, and imports inside functions count like any others.
"""

import ast
import json
import re
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "thermorender"
DRAWING = Path(__file__).with_name("architecture.svg")
# The core, from the ground up, with what each room holds: a room imports only from itself and from those before it.
CORE = {
    "ground": "errors, units, defaults, paths, versions, files, formats, numbers, cache, schema, progress, timing",
    "physics": "Planck's law, bands, emission, Fresnel, surfaces, sun, heat, geodesy: NumPy only",
    "atmosphere": "air: model, rays, profile, standard table, MODTRAN, LOWTRAN7's aerosols",
    "weather": "a station's, a typical year's or a named day's: missing values are modelled, wrong ones refused",
    "materials": "one material, the library, mixtures, files",
    "trajectory": "flight logs to timed poses",
    "sensor": "radiance to counts to picture; files of temperature",
    "learned": "RGB to temperature, RGB to material: maps applied",
    "scene": "the user's description: specification, terrain, mesh, objects, temperature sources",
    "frame": "the Frame: a value; its picture, files and map",
    "render": "the only importer of Mitsuba and Dr.Jit: bake, trace, budget, truth, reference",
    "output": "images, video, records, flights",
    "cli": "the registry of verbs, the core's own, and what verbs share",
}
# The applications, each a folder of `thermorender/apps`.
APPS = {
    "training": "pictures to data sets, data sets to maps",
    "compare": "maps and translations against the render",
    "lands": "scenes from a seed or from survey files",
    "survey": "from frames back to cameras and temperatures",
    "studio": "materials edited in the browser",
    "link": "frames to a simulator over a socket",
    "cluster": "work spread over processes and machines",
    "export": "labels, masks, geotagged images",
    "material_tables": "tables imported, checked, compared",
}
GROUND = {name.strip() for name in CORE["ground"].split(",")}
# The package's own front, which hands out the public names of core and applications.
FRONT = {"__init__", "__main__"}
REFERENCE = Path(__file__).with_name("reference")
# The pages of names for users, and of further names for applications.
USERS, APPLICATIONS = REFERENCE / "python.md", REFERENCE / "extension.md"


def room_of(module):
    """Return the room of a dotted name inside the package: "render" of "render.plan", "apps.link" of "apps.link.wire".

    None for the package's front, and for that of the applications.
    """
    first, _, rest = module.partition(".")
    if first == "apps":
        return f"apps.{rest.split('.')[0]}" if rest else None
    return "ground" if first in GROUND else None if first in FRONT or not first else first


def listed(page):
    """Return the (module inside the package, name) that a page lists, each `automodule` with its members."""
    text = page.read_text(encoding="utf-8")
    found = re.findall(r"^\.\. automodule:: thermorender\.(\S+)\n +:members: (.+)$", text, flags=re.M)
    return {(module, name.strip()) for module, names in found for name in names.split(",")}


def exported():
    """Return {name: dotted name inside the package of its module} of the names that `thermorender` itself exports."""
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    (homes,) = (
        node.value for node in tree.body if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "_PUBLIC"
    )
    return {name: home.removeprefix("thermorender.") for name, home in ast.literal_eval(homes).items()}


def public_names():
    """Return the (module inside the package, name) that applications may import from the core and from each other."""
    return {(home, name) for name, home in exported().items()} | listed(USERS) | listed(APPLICATIONS)


@cache
def used_by_applications():
    """Return {(module inside the package, name): set of modules} that applications import from other rooms.

    The ground is left out, which every room imports freely.
    """
    found = {}
    for module, path in modules().items():
        here = room_of(module) or ""
        if not here.startswith("apps."):
            continue
        for source, name in imported_names(path.read_text(encoding="utf-8")):
            if room_of(source) not in (here, "ground", None):
                found.setdefault((source, name), set()).add(module)
    return found


def used_by_scripts():
    """Return the (module inside the package, name) that README, pages and examples import or name in full."""
    root = PACKAGE.parent
    texts = [path.read_text(encoding="utf-8") for path in sorted((root / "examples").rglob("*.py"))]
    for path in sorted((root / "examples").glob("*.ipynb")):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        code = "".join(line for each in cells if each["cell_type"] == "code" for line in [*each["source"], "\n"])
        texts.append(re.sub(r"^[!%].*$", "", code, flags=re.M))
    known, found = modules(), set()
    for path in [root / "README.md", *sorted((root / "docs").rglob("*.md"))]:
        text = path.read_text(encoding="utf-8")
        texts += re.findall(r"^```python\n(.*?)^```", text, flags=re.S | re.M)
        found |= {pair for pair in re.findall(r"`thermorender\.([\w.]+)\.(\w+)`", text) if pair[0] in known}
    found |= {pair for text in texts for pair in imported_names(text)}
    return {(module, name) for module, name in found if f"{module}.{name}" not in known and room_of(module)}


def crossings():
    """Return the sentences on imports that break the rule of core and applications.

    The core imports no application. An application imports only public names from the core and from other applications.
    """
    public, found = public_names(), []
    for module, imported in own_imports().items():
        here = room_of(module)
        if here is not None and not here.startswith("apps."):
            there = {source for source in imported if (room_of(source) or "").startswith("apps.")}
            found += [f"{module} imports {source}, which is an application" for source in sorted(there)]
    for (source, name), by in sorted(used_by_applications().items()):
        if (source, name) not in public:
            pages = f"{USERS.name} and {APPLICATIONS.name} do not list"
            found.append(f"{', '.join(sorted(by))} imports {source}.{name}, which {pages}")
    return found


def imported_names(text):
    """Yield (module inside the package, name) of each name that code imports, or takes from a module it imports."""
    tree, known, whole = ast.parse(text), modules(), {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "thermorender":
            source = node.module.removeprefix("thermorender").lstrip(".")
            for alias in node.names:
                module = f"{source}.{alias.name}".lstrip(".")
                if module in known:
                    whole[alias.asname or alias.name] = module
                else:
                    yield source, alias.name
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in whole:
            yield whole[node.value.id], node.attr


@cache
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
    running, checked = _imports(path)
    return running | checked if typing else running


@cache
def _imports(path):
    """The sets of names that a file imports when it runs, and under `if TYPE_CHECKING:`; a file is parsed once."""
    running, checked, skipped = set(), set(), set()
    # The walk goes from the outside in: an `if` comes before what is under it.
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.If) and getattr(node.test, "id", None) == "TYPE_CHECKING":
            skipped |= {id(each) for part in node.body for each in ast.walk(part)}
        found = checked if id(node) in skipped else running
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                raise ValueError(f"{path}: a relative import; name the module from thermorender on")
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return frozenset(running), frozenset(checked)


@cache
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
    """Return the import graph as SVG: the core's rooms from the ground up in the middle, applications around it."""
    order, step, top, left, width = list(CORE), 46, 60, 330, 440
    middle = {room: top + (len(order) - 1 - number) * step + 16 for number, room in enumerate(order)}
    bottom = top + len(order) * step
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="1200" height="{bottom + 40}" font-family="sans-serif">',
        f'<rect width="1200" height="{bottom + 40}" fill="white"/>',
        f'<rect x="8" y="8" width="1184" height="{bottom + 24}" rx="30" fill="#fbf6ec" stroke="#c9a86a"/>',
        '<text x="32" y="34" font-size="15" font-weight="bold" fill="#8a6a2a">applications</text>',
        f'<rect x="{left - 20}" y="{top - 34}" width="{width + 160}" height="{bottom - top + 40}" rx="14" fill="white" '
        'stroke="#8899aa"/>',
        f'<text x="{left}" y="{top - 14}" font-size="15" font-weight="bold" fill="#445566">core</text>',
    ]
    count = room_imports()
    # Each application has a place left or right of the core; its imports of the core end at the core's frame.
    places, half = {}, (len(APPS) + 1) // 2
    for number, name in enumerate(APPS):
        right, row = number >= half, number % half
        places[name] = (950 if right else 24, top + 10 + row * (bottom - top - 40) // half)
    for (here, there), number in sorted(count.items()):
        if here.startswith("apps.") and there.startswith("apps."):
            (x0, y0), (x1, y1) = places[here[5:]], places[there[5:]]
            lines.append(
                f'<path d="M {x0 + 113} {y0 + 30} C {x0 + 113} {(y0 + y1) // 2}, {x1 + 113} {(y0 + y1) // 2}, '
                f'{x1 + 113} {y1 + 30}" fill="none" stroke="#c98a2a" stroke-opacity="0.7">'
                f"<title>{here} imports {there}: {number} modules</title></path>"
            )
        elif not here.startswith("apps."):
            start, end, edge = middle[here] + 4, middle[there] - 4, left + width
            colour = "#d62728" if order.index(there) >= order.index(here) else "#1f77b4"
            bulge = edge + 20 + 9 * abs(order.index(here) - order.index(there))
            lines += [
                f'<path d="M {edge} {start} C {bulge} {start}, {bulge} {end}, {edge + 6} {end}" fill="none" '
                f'stroke="{colour}" stroke-opacity="0.5" stroke-width="{1 + 0.4 * number**0.5:.1f}">',
                f"<title>{here} imports {there}: {number} modules</title></path>",
                f'<path d="M {edge + 7} {end - 4} l -7 4 l 7 4 z" fill="{colour}"/>',
            ]
    for room, what in CORE.items():
        y = middle[room]
        files = sum(1 for module in modules() if room_of(module) == room)
        lines += [
            f'<rect x="{left}" y="{y - 17}" width="{width}" height="36" rx="5" fill="#f2f5f8" stroke="#8899aa"/>',
            f'<text x="{left + 10}" y="{y - 2}" font-size="14" font-weight="bold">{room}</text>',
            f'<text x="{left + width - 10}" y="{y - 2}" font-size="11" text-anchor="end">{files} modules</text>',
            f'<text x="{left + 10}" y="{y + 13}" font-size="9" fill="#333">{what}</text>',
        ]
    for name, what in APPS.items():
        x, y = places[name]
        files = sum(1 for module in modules() if room_of(module) == f"apps.{name}")
        rooms = sorted(there for here, there in count if here == f"apps.{name}" and not there.startswith("apps."))
        edge, core = (x + 226, left - 20) if x < left else (x, left + width + 140)
        lines += [
            f'<path d="M {edge} {y + 30} L {core} {y + 30}" stroke="#1f77b4" stroke-opacity="0.6">'
            f"<title>{name} imports public names of {', '.join(rooms)}</title></path>",
            f'<rect x="{x}" y="{y}" width="226" height="60" rx="10" fill="#fff3d9" stroke="#c9a86a"/>',
            f'<text x="{x + 10}" y="{y + 20}" font-size="14" font-weight="bold">{name}</text>',
            f'<text x="{x + 216}" y="{y + 20}" font-size="11" text-anchor="end">{files} modules</text>',
            f'<text x="{x + 10}" y="{y + 40}" font-size="9" fill="#333">{what}</text>',
        ]
    return "\n".join([*lines, "</svg>"]) + "\n"


if __name__ == "__main__":
    DRAWING.write_text(drawing(), encoding="utf-8")
    print(DRAWING)
