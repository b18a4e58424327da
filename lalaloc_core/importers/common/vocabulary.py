"""Vocabulary of drawings: roles of layers, blocks and classes, and types of rooms, from their names.

It covers AIA layer codes (`A-DOOR`), English, German, French, Italian, Spanish, Portuguese, Dutch, Swedish, Danish,
Norwegian, Polish, Japanese and some Finnish words, and the abbreviations of plans.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from functools import lru_cache
from typing import Literal

from lalaloc_core.floorplan.rooms import ROOM_WORDS, room_type_from_label

Role = Literal["door", "window", "passage", "obstacle", "wall", "room", "text", "ignored"]

# Shorter words have no plurals but those with s.
_SHORTEST_PLURAL = 5
# Words that can be misread: the shortest, and the least share of letters that are right (`difflib`'s ratio).
_SHORTEST_READING, _MIN_ALIKE = 5, 0.84
# The first match wins: "A-WALL-DOOR" is a door layer, "window dimensions" is ignored.
_ROLES: tuple[tuple[Role, str], ...] = (
    (
        "ignored",
        "furniture furnishing furn mobel moebel mobilier mobiliario arredi meubel meubles dim dims dimension "
        "dimensions dimensiones bemassung massketten masse cotation cotes cotas quote grid grids axis axes "
        "achse achsen eje ejes asse assi meble mobili moveis mobiliario mobler inventar wymiary matt malsatning mal "
        "cotagem schody title titleblock viewport defpoints border rahmen legend sanitary sanitar "
        "sanitaires plumbing electrical elec lights appliance appliances equipment equip symbol symbols northarrow "
        "north scale stair stairs treppe treppen escalier escaleras flor ceiling clng",
    ),
    (
        "door",
        "door doors doorway dr tur turen tuer tueren porte portes puerta puertas porta porte porten deur "
        "deuren dorr dorrar dor dore dorer drzwi ovi haustur haustuer innentur innentuer zimmertur zimmertuer",
    ),
    (
        "window",
        "window windows win glaz glazing fenster fenetre fenetres ventana ventanas finestra finestre janela "
        "janelas raam ramen okno okna fonster vindu vinduer vindue ikkuna verglasung baie baies",
    ),
    (
        "passage",
        "opening openings passage passages durchgang durchgange offnung offnungen ouverture ouvertures vano abertura "
        "aberturas apertura aperture opening apning abning oppning otwor otwory doorgang",
    ),
    (
        "obstacle",
        "column columns col cols pillar pillars stutze stutzen stuetze stuetzen pfeiler saule saulen poteau "
        "poteaux columna columnas pilar pilares colonna colonne shaft shafts schacht schachte gaine gaines "
        "pilares pilastro pilastri kolom kolommen pelare sojle sojler soyle soyler slup slupy filar filary "
        "kiosk fixture elevator lift aufzug",
    ),
    (
        "wall",
        "wall walls wand wande waende mauer mauern mauerwerk mur murs cloison cloisons porteur porteurs muro "
        "muros pared paredes parete pareti tabique muur muren vagg vegg seina partition partitions aussenwand "
        "aussenwande innenwand innenwande trennwand vaggar vegger vaeg vaegge sciana sciany muren tramezzo "
        "tabiques",
    ),
    (
        "room",
        "room rooms space spaces area areas zone zones zimmer raum raume raeume raumflachen flache flachen "
        "piece pieces local locaux habitacion habitaciones estancia estancias stanza stanze locale locali "
        "ruimte ruimten ruimtes kamer kamers rum rom pomieszczenie pomieszczenia pokoje comodo comodos compartimento "
        "compartimentos vaerelse unit units",
    ),
    ("text", "text texts texte label labels name names iden note notes annotation anno beschriftung"),
)
_ROLE_OF: dict[str, Role] = {word: role for role, words in reversed(_ROLES) for word in words.split()}
_ORDER: list[Role] = [role for role, _ in _ROLES]
# German compounds: "Zimmertür", "Gipskartonwand", "Dachfenster".
_ENDINGS: Mapping[str, Role] = {"tur": "door", "tuer": "door", "turen": "door", "fenster": "window", "wand": "wall",
                                "wande": "wall", "waende": "wall", "mauer": "wall", "zimmer": "room"}  # fmt: skip
# Room names in other languages and abbreviations, by the English word that `room_type_from_label` knows.
_ENGLISH: Mapping[str, str] = {
    word: english
    for english, words in {
        "bathroom": (
            "bad baeder bader badezimmer dusche gastewc gaestewc duschbad sdb sde salle_de_bain salledebain "
            "salledeau toilettes toilette toiletten lavabo bano aseo aseos servicio banheiro lavabos "
            "casa_de_banho casadebanho bagno bagni servizi badkamer douche badrum dusch toalett toaletter "
            "badevaerelse brusebad baderom toalet lazienka ubikacja kph powder ensuite pwdr"
        ),
        "bedroom": (
            "schlafzimmer schlafen kinderzimmer gastezimmer gaestezimmer elternzimmer sz chambre chambres chbre chb "
            "dormitorio dormitorios dorm alcoba camera camere cameretta quarto quartos slaapkamer slpk sovrum "
            "sov sovevaerelse vaerelse kammer soverom sov1 sypialnia mh br bed bdrm mbr"
        ),
        "living": (
            "wohnzimmer wohnen wz stube salon salones sejour soggiorno sala salaestar estar saladeestar "
            "woonkamer livingroom vardagsrum stue opholdsstue opholdsrum dagligstue salonik pokoj_dzienny "
            "pokojdzienny pokoj oh lr liv"
        ),
        "kitchen": (
            "kuche kueche kochen kochnische cuisine cuis kitch cocina cucina cozinha keuken kok kokken kjokken "
            "kuchnia aneks keittio kt kf kit kochinsel"
        ),
        "dining": (
            "esszimmer essen essplatz salle_a_manger salleamanger comedor pranzo jantar saladejantar "
            "saladapranzo eetkamer matrum matsal matplats spisestue spiseplads jadalnia diningroom dr"
        ),
        "corridor": (
            "flur gang diele korridor couloir couloirs dgt degagement palier pasillo distribuidor corridoio "
            "disimpegno corredor gangway overloop hal passagem korytarz hol gangen korridorer circulation"
        ),
        "entrance": (
            "eingang windfang entree vestibulo recibidor ingresso hall_de_entrada foyer inkom hallen entre "
            "bryggers vindfang przedpokoj sien wiatrolap et"
        ),
        "closet": (
            "ankleide dressing dress garderobe vestidor armario closet guardaroba cabina kast kladkammare "
            "kladeskab garderob garderoba wic wicl clo"
        ),
        "storage": (
            "abstellraum abstellkammer abst keller lager speis speisekammer vorrat debarras cellier cave "
            "rangement rgt trastero despensa bodega ripostiglio cantina magazzino arrumos arrecadacao berging "
            "voorraad forrad skafferi lagerrum depotrum pulterrum bod kjeller spizarnia piwnica magazyn"
        ),
        "laundry": (
            "waschkuche waschkueche hauswirtschaftsraum hwr waschraum buanderie lavadero lavanderia wasruimte "
            "tvattstuga tvatt vaskerum vaskerom pralnia"
        ),
        "garage": "garaje autorimessa garagem carport garaz",
        "stairs": (
            "treppe treppen treppenhaus trh escalier escaliers escalera escaleras scala escada escadas trap "
            "trappen trappa trapphus trappe trapperum trapperom schody klatka klatka_schodowa"
        ),
        "balcony": (
            "balkon balkone terrasse terrassen loggia balcon balcones terraza balcone balconi terrazzo varanda "
            "varandas terraco balkong altan terrass uteplats taras"
        ),
        "office": (
            "buro buero arbeitszimmer bureau bureaux despacho oficina oficinas ufficio uffici studio_lavoro "
            "escritorio gabinete kantoor kantoren werkkamer kontor kontorer arbetsrum biuro gabinet"
        ),
        "meeting": (
            "besprechung besprechungsraum sitzungszimmer reunion reuniones riunione riunioni salariunioni "
            "salareuniones salareunioes salledereunion reuniao vergaderruimte vergaderzaal motesrum moterom "
            "sammantradesrum modelokale konferencyjna konferencja"
        ),
        "hall": "saal aula halle",
    }.items()
    for word in words.split()
}
# Room names in Japanese, where words are not separated; the first that a label contains decides.
_JAPANESE: tuple[tuple[str, str], ...] = tuple(
    (word, kind)
    for kind, words in (
        ("bathroom", "浴室 バスルーム 洗面 脱衣 便所 トイレ お手洗 シャワー"),
        ("kitchen", "台所 キッチン 厨房"),
        ("living", "居間 リビング"),
        ("dining", "食堂 ダイニング"),
        ("bedroom", "寝室 主寝室 子供室 洋室 和室"),
        ("entrance", "玄関 ホール"),
        ("corridor", "廊下"),
        ("closet", "クローゼット クロゼット 押入 物入"),
        ("storage", "納戸 収納 倉庫 物置"),
        ("laundry", "洗濯"),
        ("stairs", "階段"),
        ("balcony", "バルコニー ベランダ テラス"),
        ("garage", "車庫 ガレージ"),
        ("meeting", "会議"),
        ("office", "事務 書斎 執務"),
    )
    for word in words.split()
)
_JAPANESE_ROLES: tuple[tuple[str, Role], ...] = (
    *((word, "ignored") for word in ("家具", "寸法", "通り芯", "設備")),
    *((word, "door") for word in ("ドア", "扉", "建具")),
    *((word, "window") for word in ("窓", "サッシ")),
    ("開口", "passage"),
    ("柱", "obstacle"),
    ("壁", "wall"),
    ("部屋", "room"),
    *((word, "text") for word in ("室名", "文字")),
)
# Letters that have no base letter with an accent.
_LETTERS = str.maketrans({"ß": "ss", "ø": "o", "Ø": "O", "æ": "ae", "Æ": "AE", "ł": "l", "Ł": "L", "đ": "d", "œ": "oe"})
# Words for roofs, and those that stand beside them in names of levels.
_ROOFS, _OF_LEVELS = (
    frozenset(words.split())
    for words in (
        "roof roofs roofing dach dacher toit toiture toits tetto copertura cubierta tejado cobertura telhado dak tak "
        "yttertak tag",
        "level floor storey story plan ebene stockwerk niveau etage livello piano nivel planta piso andar verdieping "
        "niva etasje poziom pietro le la il el o het",
    )
)


def split_words(text: str) -> list[str]:
    """Split a name such as "A-DOOR_Frame", "LivingRoom" or "Außentür" into lower-case words without accents."""
    spaced = re.sub(r"(?<=[a-zß-öø-ÿł])(?=[A-ZÀ-ÞŁ])", " ", text)
    folded = unicodedata.normalize("NFKD", spaced.translate(_LETTERS)).encode("ascii", "ignore").decode().casefold()
    return re.findall(r"[a-z]+", folded)


def is_roof(level: str) -> bool:
    """Return whether a level is a roof by its name: "Roof", "Roof level", "04 - Dach", but no "Roof terrace"."""
    words = [word for word in split_words(level) if word not in _OF_LEVELS]
    return bool(words) and all(word in _ROOFS for word in words)


def mentions_roof(level: str) -> bool:
    """Return whether a level is at a roof by its name, such as "Roof terrace"."""
    return any(word in _ROOFS for word in split_words(level))


def role_from_name(text: str) -> Role | None:
    """Return the role of a layer, block or class from its name, None if the name gives none."""
    found = {role for word in split_words(text) if (role := _role_of_word(word)) is not None}
    japanese = unicodedata.normalize("NFKC", text)
    found |= {role for word, role in _JAPANESE_ROLES if word in japanese}
    return next((role for role in _ORDER if role in found), None)


def room_type_from_name(label: str | None) -> str | None:
    """Return the plan's room type for a name or class, None if it is not known."""
    if not label:
        return None
    # Compare whole words only: the Finnish "et" must not match "sheet".
    words = split_words(label)
    for word in ("".join(words), "".join(word.removesuffix("s") for word in words), *words):
        for form in (word, *_singulars(word)):
            found = room_type_from_label(_ENGLISH.get(form, form))
            if found != "unknown":
                return found
    text = unicodedata.normalize("NFKC", label)
    return next((kind for word, kind in _JAPANESE if word in text), None)


@lru_cache(maxsize=1024)
def room_type_from_reading(text: str | None) -> str | None:
    """Return the room type for a text in a picture, of whose letters one or two may be misread ("lving", "corrid")."""
    found = room_type_from_name(text)
    if found is not None or not text:
        return found
    words = [word for word in split_words(text) if len(word) >= _SHORTEST_READING]
    known = (*ROOM_WORDS, *_ENGLISH)
    likely = (get_close_matches(word, known, n=1, cutoff=_MIN_ALIKE) for word in words)
    return next((room_type_from_name(word) for found_words in likely for word in found_words), None)


def _singulars(word: str) -> Iterator[str]:
    """Yield what a plural can come from: "Offices", "Lobbies", "Küchen", "Toiletter", "Camere", "Sypialnie"."""
    yield f"{word[:-3]}y" if word.endswith("ies") else word.removesuffix("s")
    yield word.removesuffix("es")
    if len(word) > _SHORTEST_PLURAL:
        yield from (word.removesuffix(ending) for ending in ("en", "er", "n", "r") if word.endswith(ending))
        if word[-1] in "eiy":
            yield f"{word[:-1]}a"


def _role_of_word(word: str) -> Role | None:
    if word in _ROLE_OF:
        return _ROLE_OF[word]
    return next((role for ending, role in _ENDINGS.items() if word.endswith(ending) and len(word) > len(ending)), None)
