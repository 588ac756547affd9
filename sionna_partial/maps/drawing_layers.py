"""Names of the layers of drawings: which are walls, in languages of Europe and in the AIA/NCS standard."""

import re

WALL_NAMES = re.compile(
    r"wall|wand|wänd|mauer|mur(?!al)|pared|parete|vägg|vegg|muur|sciana|ściana|стен|colum|pillar|s-cols|stütze|partition|"
    r"window|glaz|fenster|fenetre|fenêtre|ventana|finestra",
    re.IGNORECASE,
)
"""What names of layers with walls, columns and windows contain."""

NO_WALL_NAMES = {
    reason: re.compile(words, re.IGNORECASE)
    for reason, words in {
        "texts, dimensions or door headers": r"head|text|dim|anno|iden|note",
        "furniture": r"furn|möbel|mobel|schrank",
        "lamps or sockets": r"-lite|light|lamp|leucht|lumin|sconce|socket|steckdose|outlet",
        "to be demolished": r"demo(?![a-z])|demol|démol|abbruch|abriss|rückbau|sloop|rivning|wyburz",
    }.items()
}
"""What names of layers contain that describe walls, close doors, or hold walls that will not be there."""

AIA_WALLS = {"WALL", "GLAZ", "COLS", "PRTN"}
"""Major groups of the AIA/NCS standard with walls, windows and columns."""

AIA_STATUS = {"D": "to be demolished", "F": "future work", "M": "to be moved", "T": "temporary"}
"""Last fields of AIA/NCS names of walls that are not part of the finished building."""

PARTIAL_HEIGHT = re.compile(r"(?<![a-z])prht(?![a-z])|partial.?height|halbhoch|brüstung", re.IGNORECASE)
"""What names of layers contain whose walls end below the ceiling."""

NO_WALL = "name of no wall"

_AIA = re.compile(r"([A-Z]{1,2})-([A-Z]{4})((?:-[A-Z0-9]{4})*)(?:-([A-Z1-9]))?", re.IGNORECASE)
_REFERENCE = re.compile(r"\||\$\d+\$")


def skip_reason(name: str) -> str:
    """Return the reason for which a layer is not read as walls, "" for one with walls.

    Names of the AIA/NCS standard are discipline, major group, minor groups and status: its major group decides whether
    it has walls. The name of an external reference in front is left out.
    """
    name = _REFERENCE.split(name)[-1]
    parts = _AIA.fullmatch(name)
    if parts and parts[2].upper() not in AIA_WALLS and not WALL_NAMES.search(parts[2]):
        return "major group of no wall (AIA/NCS)"
    for reason, words in NO_WALL_NAMES.items():
        if words.search(name):
            return reason if WALL_NAMES.search(name) else f"{NO_WALL}: {reason}"
    if not WALL_NAMES.search(name) and not parts:
        return NO_WALL
    return AIA_STATUS.get((parts[4] or "").upper(), "") if parts else ""
