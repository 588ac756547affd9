"""Layers of the walls of building models: names to materials, and the one slab that stands for all layers."""

import math
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sionna_partial.constants import CARRIER_FREQUENCY_HZ, SPEED_OF_LIGHT_M_S
from sionna_partial.settings import Material, material_name

MAX_THICKNESS_M = 10.0

FREQUENCIES_HZ = (2.4e9, 5.2e9, CARRIER_FREQUENCY_HZ)
"""Carriers for which an import reports the loss of walls [Hz]."""

P2040 = {
    "concrete": (5.24, 0.0462, 0.7822),
    "brick": (3.91, 0.0238, 0.16),
    "plasterboard": (2.73, 0.0085, 0.9395),
    "wood": (1.99, 0.0047, 1.0718),
    "glass": (6.31, 0.0036, 1.3394),
    "chipboard": (2.58, 0.0217, 0.78),
    "marble": (7.074, 0.0055, 0.9262),
    "metal": (1.0, 1e7, 0.0),
}
"""Permittivity, and factor and exponent of the conductivity c (f / GHz)^d [S/m] (ITU-R P.2040-3, table 3)."""

NO_LOSS = ""
"""Name of frames, air, insulation and membranes, which lose next to nothing."""

NAMES = {
    "metal foil": r"alu\w*[ -]*(?:foil|folie|film)",
    "concrete frame": r"(?:concrete|beton)[ -]+fram\w*",
    "insulation": r"(?:insulation|isolation|isolierung|dammung|dammplatte|dammstoff|isolant|aislamiento|aislante|"
    r"isolering|isolatie|eriste|eristys|izolac|isolamento).*|\w*(?:wool|wolle)\b|\b(?:laine|lana|la) d[ei]\b.*|"
    r"fib(?:er|re)glass|glass ?fib\w*|glasfaser|glasvlies|wood ?fib\w*|holzfaser\w*|(?:schaum|foam)[ -]?glas\w*|"
    r"foamed glass|cellular glass|cellulose|zellulose|hanf|hemp|stroh|straw|\bcork|\bkork|\bfoam|schaum|polysty|"
    r"styro|polyur|\b(?:eps|xps|pir|pur)\b|aerogel|mineral ?fib\w*",
    "frame": r"\bstuds?\b|\w*stander\w*|furring|\bfram(?:e|es|ing)\b|\w*rahmen\w*|batten|\blaths?\b|lattung|latten\b|"
    r"unterkonstruktion|substructure|montant|ossature|\bjoist|rafter|purlin|mullion|(?:metal|stahl|steel) ?profil\w*|"
    r"metallprofil\w*|\b[cu][dw]?[ -]?profil\w*",
    "air": r"\bair\b|air ?(?:gap|space)|\bluft\w*|cavity|hohlraum|\bvoid|lame d.air|camara|intercapedine|argon|"
    r"krypton|spouw",
    "membrane": r"membran|vapou?r|barrier|retarder|damp\w*|\bfoil|folie|\bfilm|\bfelt|vlies|paper|papier|paint|"
    r"anstrich|tapete|carpet|teppich|adhesive|kleber|plastic|kunststoff|\bpvc\b|vinyl|acryl|polycarbonat|rubber|"
    r"bitumen|waterproof|abdichtung",
    "coated glass": r"(?:coated|\blow.?e\b)(?:.*gla[sz]\w*)?|(?:sonnen|warme)schutz(?:ver)?glas\w*",
    "glass": r"gla[sz]\w*|verglas\w*|isolier(?:ver)?glas\w*|vitr\w*|\bverre\b|vidrio|vetro|vidro|szklo|\bsklo|uveg",
    "reinforced concrete": r"reinforced|stahlbeton\w*|concrete.*reinforced|beton arme|armado|armato|zelezobeton|zelbet",
    "concrete": r"concrete(?: masonry(?: units?)?)?|\w*beton\w*|\bcmu\b|cement|zement|hormigon|calcestruzzo|screed|"
    r"estrich|precast|\bblock(?:s|work)?\b",
    "brick": r"brick\w*(?:[ -]+blocks?)?|masonry|ziegel\w*|mauerwerk|klinker|clinker|brique|ladrillo|mattone|laterizio|"
    r"kalksand\w*|calcium silicate|sand.?lime|\bclay|lehm|adobe|mortar|mortel|\btiles?\b|fliese|ceramic|keramik|"
    r"baksteen|tegel|tiili|tegla|cegla|tijolo|terracotta",
    "marble": r"\w*stone|naturstein|\bstein|sandstein|granit|marble|marmor|\bslate|schiefer|pierre|piedra|pietra",
    "plasterboard": r"(?:gyps|gips)\w*(?:[ -]+blocks?)?|drywall|dry wall|plaster\w*|\bgk[bf]\b|sheetrock|rigips|"
    r"fermacell|stucco|putz\b|\brender\w*|placo|yeso|gesso|intonaco|enduit|platre|pladur|wallboard",
    "chipboard": r"chipboard|particle ?board|plywood|\b(?:osb|mdf|hdf)\b|spanplatte|sperrholz|hardboard|hartfaser|"
    r"holzwerkstoff|contreplaque",
    "wood": r"wood|timber|lumber|\w*holz\w*|\bbois\b|madera|legno|\boak\b|eiche|buche|fichte|kiefer|\bpine\b|spruce|"
    r"larch|\bhout|drewno|drevo",
    "metal": r"metal|steel|stahl|alumin|\balu\b|\biron|\beisen|blech|\bzin[ck]|copper|kupfer|\bacier|\bacero|acciaio",
}
"""Patterns of names of layers without accents. The last match counts: "metal stud" is a stud, "glass wool" wool."""

MATERIALS = {
    **dict.fromkeys(("insulation", "frame", "air", "membrane"), NO_LOSS),
    "metal foil": "metal",
    "concrete frame": "concrete",
    "reinforced concrete": "concrete",
}
"""Materials of names that are none themselves."""

SOLID = ("concrete", "reinforced concrete", "brick", "wood", "marble")
"""Materials whose walls are as thick as their bodies if no layer has a thickness."""

LIGHT = Material(1.05, 0.0)
"""Wall of insulation or frames alone."""

_NAMES = re.compile("|".join(f"(?P<_{k}>{pattern})" for k, pattern in enumerate(NAMES.values())), re.IGNORECASE)
_ADDED = re.compile(r"\b(?:with|w/|mit|avec|con|med|met|on|auf)\b.*", re.IGNORECASE)
_PLAIN = str.maketrans({"ł": "l", "ø": "o", "ß": "ss"})


class Layer(NamedTuple):
    """A layer by its name in the file, and its thickness [m]; 0 if the file has none."""

    text: str
    thickness_m: float

    @property
    def name(self) -> str | None:
        """Name of the layer's kind (a key of `NAMES`); None if unknown."""
        text = "".join(c for c in unicodedata.normalize("NFKD", self.text) if not unicodedata.combining(c))
        head = _ADDED.sub("", text.translate(_PLAIN))
        found = [*_NAMES.finditer(head.strip() or text)]
        return [*NAMES][int(str(found[-1].lastgroup)[1:])] if found else None

    @property
    def loses(self) -> bool:
        """Return whether the layer counts."""
        return self.name is not None and MATERIALS.get(self.name, self.name) != NO_LOSS


def slab(layers: Sequence[Layer], usual: str | None, width_m: float | None) -> Material | None:
    """Return the slab that stands for the layers of a wall, or None if its material is unknown.

    `usual` is the material of the element's type if no layer has another; `width_m` is the width of the body of a wall,
    None for other elements. Layers of one material have the sum of their thicknesses, layers of several the mean
    constants. Any metal makes a metal wall. The material is unknown if layers with unknown names are thickest.
    """
    counted = [layer for layer in layers if layer.loses]
    thick = [layer for layer in counted if layer.thickness_m > 0]
    whole_m = sum(layer.thickness_m for layer in layers)
    if not counted or sum(layer.thickness_m for layer in layers if layer.name is None) > whole_m / 2:
        if usual is not None:
            return Material.named(usual)
        is_light = bool(layers) and all(layer.name is not None and not layer.loses for layer in layers)
        return replace(LIGHT, thickness_m=round(whole_m or width_m or 0.1, 4)) if is_light else None
    names = [str(layer.name) for layer in counted]
    if "metal" in (kinds := [MATERIALS.get(name, name) for name in names]):
        return Material.named("metal")
    if not thick:
        name = max(names, key=lambda name: loss_db(_usual(name), FREQUENCIES_HZ[1]))
        if width_m is not None and name in SOLID and width_m > 0:
            return _slab_of({MATERIALS.get(name, name): width_m})
        return _usual(name)
    if "coated glass" in names:
        return Material.named("coated glass")
    total_m = dict[str, float]()
    for kind, layer in zip(kinds, counted, strict=True):
        total_m[kind] = total_m.get(kind, 0.0) + layer.thickness_m
    return _slab_of(total_m)


def loss_db(material: Material, frequency_hz: float) -> float:
    """Return the loss of a slab at normal incidence [dB] (ITU-R P.2040-3, eq. 43)."""
    permittivity, conductivity_s_m = constants_at(material, frequency_hz)
    root = np.sqrt(permittivity - 1j * conductivity_s_m / (2 * math.pi * frequency_hz * 8.8541878128e-12))
    once = np.exp(-2j * math.pi * frequency_hz / SPEED_OF_LIGHT_M_S * material.thickness_m * root)
    face = (1.0 - root) / (1.0 + root)
    return float(-20.0 * np.log10(max(abs((1.0 - face**2) * once / (1.0 - face**2 * once**2)), 1e-15)))


def constants_at(material: Material, frequency_hz: float) -> tuple[float, float]:
    """Return permittivity and conductivity [S/m] without Sionna's table, which takes seconds to load."""
    if material.itu is None:
        grown = (frequency_hz / CARRIER_FREQUENCY_HZ) ** material.conductivity_exponent
        return material.relative_permittivity, material.conductivity_s_m * grown
    permittivity, factor, exponent = P2040[material.itu]
    return permittivity, factor * (frequency_hz / 1e9) ** exponent


def described(kind: str, layers: Sequence[Layer], material: Material | None) -> str:
    """Return a line of the import report: the layers of a wall and the loss of its slab."""
    texts = []
    for layer in layers:
        size = f" {1000 * layer.thickness_m:.4g} mm" if layer.thickness_m else ""
        kept = "" if layer.loses else " (unknown)" if layer.name is None else " (no loss)"
        texts.append(f"{layer.text or 'unnamed'}{size}{kept}")
    if material is None:
        return f"{kind} of {' + '.join(texts) or 'no material'}: unknown material"
    losses = ", ".join(
        "> 100" if loss > 100 else f"{loss:.1f}" for loss in (loss_db(material, f) for f in FREQUENCIES_HZ)
    )
    name = material_name(material).removeprefix("a custom material") or "one slab"
    carriers = ", ".join(f"{f / 1e9:g}" for f in FREQUENCIES_HZ)
    slab_text = f"{name} of {1000 * material.thickness_m:.4g} mm"
    return f"{kind} of {' + '.join(texts) or 'no material'}: {slab_text}, {losses} dB at {carriers} GHz"


def _usual(name: str) -> Material:
    return Material.named("drywall" if name == "plasterboard" else MATERIALS.get(name, name))


def _slab_of(total_m: dict[str, float]) -> Material:
    thickness_m = sum(total_m.values())
    thick_m = min(round(thickness_m, 4), MAX_THICKNESS_M)
    if len(total_m) == 1:
        return Material(itu=next(iter(total_m)), thickness_m=thick_m)
    # The slab has the phase and the absorption of its layers at normal incidence.
    index = sum(math.sqrt(P2040[name][0]) * part_m for name, part_m in total_m.items()) / thickness_m
    low, high = (
        sum(
            P2040[name][1] * (f / 1e9) ** P2040[name][2] * part_m / math.sqrt(P2040[name][0])
            for name, part_m in total_m.items()
        )
        * index
        / thickness_m
        for f in (FREQUENCIES_HZ[0], CARRIER_FREQUENCY_HZ)
    )
    exponent = math.log(high / low) / math.log(CARRIER_FREQUENCY_HZ / FREQUENCIES_HZ[0])
    return Material(round(index**2, 3), round(high, 5), thick_m, conductivity_exponent=round(exponent, 4))
