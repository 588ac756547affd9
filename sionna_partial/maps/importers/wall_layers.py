"""Names of layers with walls, in European and Asian languages or by the AIA/NCS standard."""

import re
import unicodedata

WALL_WORDS = {
    "English": "wall partition colum pillar s-cols window glaz",
    "German": "wand wänd mauer stütze säule fenster",
    "French": "mur(?!al) cloison poteau fenêtre vitr",
    "Spanish": "pared muro tabique pilar ventana",
    "Italian": "parete pareti tramezz pilastr finestra",
    "Portuguese": "parede alvenaria janela",
    "Dutch": "muur kolom <raam>",
    "Swedish": "vägg pelare fönster",
    "Norwegian": "vegg søyle vindu",
    "Danish": "væg søjle",
    "Finnish": "seinä pilari ikkuna",
    "Estonian": "<sein <aken",
    "Latvian, Lithuanian": "<sien[aou]",
    "Polish": "ścian słup <okn",
    "Czech, Slovak": "<stěn[aoy] <zeď> <zdi zdiv příčk priečk sloup <stĺp",
    "Hungarian": "<fal> <fala válaszfal főfal oszlop pillér ablak",
    "Romanian": "perete pereți zidăr <stâlp fereastr ferestre",
    "Croatian, Serbian, Slovenian": "<zid <stup(?!id) prozor зид прозор",
    "Russian, Bulgarian": "стен перегород колон окн окон",
    "Ukrainian": "стін стін вікн вікон",
    "Greek": "τοίχο τοιχ κολών παράθυρ toich toix",
    "Turkish": "duvar kolon pencere",
    "Indonesian, Malay": "dinding tembok jendela",
    "Vietnamese": "tường tuong vách <cột> cửa_sổ",
    "Chinese": "墙 牆 柱 窗",
    "Japanese": "壁 柱 窓",
    "Korean": "벽 기둥 창문",
    "Thai": "ผนัง กำแพง เสา หน้าต่าง",
    "Arabic, Persian": "جدار حائط عمود نافذة دیوار",
    "Hebrew": "קיר עמוד חלון",
    "Hindi": "दीवार",
}
"""Patterns of names of layers with walls, columns and windows; < and > are ends of words, accents do not count."""


_LETTERS = str.maketrans({"ł": "l", "ø": "o", "æ": "ae", "\u0131": "i"})


def _plain(text: str) -> str:
    """Return text in lower case without accents."""
    kept = (letter for letter in unicodedata.normalize("NFKD", text) if not unicodedata.combining(letter))
    return "".join(kept).casefold().translate(_LETTERS)


_ENDS = {"<": "(?<![^\\W\\d_])", ">": "(?![^\\W\\d_])", "_": "[ _-]?"}
_WALLS = "|".join(word for words in WALL_WORDS.values() for word in _plain(words).split())
WALL_NAMES = re.compile(re.sub("[<>_]", lambda found: _ENDS[found[0]], _WALLS))
"""Words in names of layers with walls, columns and windows, for `_plain` names."""

NO_WALL_NAMES = {
    reason: re.compile(words, re.IGNORECASE)
    for reason, words in {
        "texts, dimensions or door headers": r"head|text|dim|anno|iden|note",
        "furniture": r"furn|möbel|mobel|schrank",
        "doors": r"门窗|門窗",
        "axes": r"芯|轴|軸",
        "lamps or sockets": r"-lite|light|lamp|leucht|lumin|sconce|socket|steckdose|outlet",
        "above the room": r"ovhd|overhead",
        "to be demolished": r"demo(?![a-z])|demol|démol|abbruch|abriss|rückbau|sloop|rivning|wyburz",
    }.items()
}
"""Words in names of layers that describe walls, close doors, or contain walls to be demolished."""

AIA_WALLS = {"WALL", "GLAZ", "COLS", "PRTN"}
"""Major groups of the AIA/NCS standard with walls, windows and columns."""

AIA_STATUS = {"D": "to be demolished", "F": "future work", "M": "to be moved", "T": "temporary"}
"""Status fields of AIA/NCS names of walls outside the finished building."""

AIA_DEMOLITION = {"AD", "ID", "SD"}

PARTIAL_HEIGHT = re.compile(r"(?<![a-z])prht(?![a-z])|partial.?height|halbhoch|brüstung", re.IGNORECASE)
"""Words in names of layers with walls that end below the ceiling."""

NO_WALL = "name of no wall"

_AIA = re.compile(r"([A-Z]{1,2})-([A-Z]{4})((?:-[A-Z0-9]{4})*)(?:-([A-Z1-9]))?", re.IGNORECASE)
_REFERENCE = re.compile(r"\||\$\d+\$")


def skip_reason(name: str) -> str:
    """Return the reason for which a layer is not read as walls, "" for walls.

    The major group of an AIA/NCS name decides. Names of external references in front are ignored.
    """
    name = unicodedata.normalize("NFC", _REFERENCE.split(name)[-1])
    parts = _AIA.fullmatch(name)
    if parts and parts[2].upper() not in AIA_WALLS and not WALL_NAMES.search(_plain(parts[2])):
        return "major group of no wall (AIA/NCS)"
    is_wall = WALL_NAMES.search(_plain(name))
    for reason, words in NO_WALL_NAMES.items():
        if words.search(name):
            return reason if is_wall else f"{NO_WALL}: {reason}"
    if not parts:
        return "" if is_wall else NO_WALL
    status = "D" if parts[1].upper() in AIA_DEMOLITION else (parts[4] or "").upper()
    return AIA_STATUS.get(status, "")
