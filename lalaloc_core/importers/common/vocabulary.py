"""Vocabulary of drawings: roles of layers, blocks and classes, and types of rooms, from their names.

It covers AIA layer codes (`A-DOOR`), English, German, French, Spanish, Italian, Dutch and some Nordic words.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping
from typing import Literal

from lalaloc_core.floorplan.rooms import room_type_from_label

Role = Literal["door", "window", "passage", "obstacle", "wall", "room", "text", "ignored"]

# The first match wins: "A-WALL-DOOR" is a door layer, "window dimensions" is ignored.
_ROLES: tuple[tuple[Role, str], ...] = (
    (
        "ignored",
        "furniture furnishing furn mobel moebel mobilier mobiliario arredi meubel meubles dim dims dimension "
        "dimensions dimensiones bemassung massketten masse cotation cotes cotas quote grid grids axis axes "
        "achse achsen eje ejes asse assi title titleblock viewport defpoints border rahmen legend sanitary sanitar "
        "sanitaires plumbing electrical elec lights appliance appliances equipment equip symbol symbols northarrow "
        "north scale stair stairs treppe treppen escalier escaleras flor ceiling clng",
    ),
    (
        "door",
        "door doors doorway dr tur turen tuer tueren porte portes puerta puertas porta porte porten deur "
        "deuren dorr dor dorer ovi haustur haustuer innentur innentuer zimmertur zimmertuer",
    ),
    (
        "window",
        "window windows win glaz glazing fenster fenetre fenetres ventana ventanas finestra finestre janela "
        "janelas raam ramen okno fonster vindu vindue ikkuna verglasung baie baies",
    ),
    ("passage", "opening openings passage passages durchgang durchgange offnung offnungen ouverture ouvertures vano"),
    (
        "obstacle",
        "column columns col cols pillar pillars stutze stutzen stuetze stuetzen pfeiler saule saulen poteau "
        "poteaux columna columnas pilar pilares colonna colonne shaft shafts schacht schachte gaine gaines "
        "kiosk fixture elevator lift aufzug",
    ),
    (
        "wall",
        "wall walls wand wande waende mauer mauern mauerwerk mur murs cloison cloisons porteur porteurs muro "
        "muros pared paredes parete pareti tabique muur muren vagg vegg seina partition partitions aussenwand "
        "aussenwande innenwand innenwande trennwand",
    ),
    (
        "room",
        "room rooms space spaces area areas zone zones zimmer raum raume raeume raumflachen flache flachen "
        "piece pieces local locaux habitacion habitaciones estancia estancias stanza stanze locale locali "
        "ruimte ruimten kamer kamers rum rom unit units",
    ),
    ("text", "text texts texte label labels name names iden note notes annotation anno beschriftung"),
)
_ROLE_OF: dict[str, Role] = {word: role for role, words in reversed(_ROLES) for word in words.split()}
_ORDER: list[Role] = [role for role, _ in _ROLES]
# German compounds: "Zimmertür", "Gipskartonwand", "Dachfenster".
_ENDINGS: Mapping[str, Role] = {"tur": "door", "tuer": "door", "turen": "door", "fenster": "window", "wand": "wall",
                                "wande": "wall", "waende": "wall", "mauer": "wall", "zimmer": "room"}  # fmt: skip
# Room names in other languages, by the English word that `room_type_from_label` knows.
_ENGLISH: Mapping[str, str] = {
    word: english
    for english, words in {
        "bathroom": "bad badezimmer dusche gastewc sdb salle_de_bain toilettes toilette bano aseo bagno badkamer kph",
        "bedroom": "schlafzimmer kinderzimmer gastezimmer chambre dormitorio camera slaapkamer mh",
        "living": "wohnzimmer wohnen stube salon sejour soggiorno woonkamer livingroom oh",
        "kitchen": "kuche kueche kochen cuisine cocina cucina keuken keittio",
        "dining": "esszimmer essen comedor pranzo eetkamer diningroom",
        "corridor": "flur gang diele korridor couloir pasillo corridoio hal gangway circulation",
        "entrance": "eingang windfang entree vestibulo ingresso foyer et",
        "closet": "ankleide dressing garderobe vestidor wic",
        "storage": "abstellraum abstellkammer keller lager speis debarras cave trastero ripostiglio berging",
        "laundry": "waschkuche hauswirtschaftsraum hwr buanderie lavadero lavanderia",
        "stairs": "treppe treppenhaus escalier escalera scala trap",
        "balcony": "balkon terrasse loggia balcon terraza balcone",
        "office": "buro buero arbeitszimmer bureau despacho ufficio kantoor",
        "meeting": "besprechung sitzungszimmer reunion riunione",
        "hall": "saal aula halle",
    }.items()
    for word in words.split()
}


def split_words(text: str) -> list[str]:
    """Split a name such as "A-DOOR_Frame", "LivingRoom" or "Außentür" into lower-case words without accents."""
    spaced = re.sub(r"(?<=[a-zß-öø-ÿ])(?=[A-ZÀ-Þ])", " ", text)
    folded = unicodedata.normalize("NFKD", spaced.replace("ß", "ss")).encode("ascii", "ignore").decode().casefold()
    return re.findall(r"[a-z]+", folded)


def role_from_name(text: str) -> Role | None:
    """Return the role of a layer, block or class from its name, None if the name gives none."""
    found = {role for word in split_words(text) if (role := _role_of_word(word)) is not None}
    return next((role for role in _ORDER if role in found), None)


def room_type_from_name(label: str | None) -> str | None:
    """Return the plan's room type for a name or class, None if it is not known."""
    if not label:
        return None
    # Compare whole words only: the Finnish "et" must not match "sheet".
    words = split_words(label)
    joined = "".join(words)
    english = [_ENGLISH.get(word, word) for word in (*words, joined)]
    found = room_type_from_label(" ".join(english))
    return None if found == "unknown" else found


def _role_of_word(word: str) -> Role | None:
    if word in _ROLE_OF:
        return _ROLE_OF[word]
    return next((role for ending, role in _ENDINGS.items() if word.endswith(ending) and len(word) > len(ending)), None)
