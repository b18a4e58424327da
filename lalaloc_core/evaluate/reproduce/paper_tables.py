"""Tables of the paper with its figures, which its authors measured on Structured3D.

Shares are fractions. Rows of our own have no figure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from lalaloc_core.evaluate.methods.method import QueryKind
from lalaloc_core.evaluate.reproduce.table import SHIPPED, Column, Row, RowQuery, Table
from lalaloc_core.evaluate.runs.predictions import MethodName

_ACCURACY = ("median_cm", "within_1cm", "within_5cm", "within_10cm", "within_1m")
_RECALL = ("layout_recall", "pose_recall")
_RETRIEVAL = (*_RECALL, "median_cm")
_LAYOUT, _PHOTOGRAPH = "Layout", "Photograph"
_TIMES: tuple[Column, ...] = ("seconds:retrieve", "seconds:vdr", "seconds:lpo", "seconds")
_ORACLE, _ICP_DEPTH = "Oracle (nearest layout by Chamfer)", "2D ICP on furnished depth"
_PAPER, _OURS = "LaLaLoc `paper`", "LaLaLoc, shipped model"
_HORIZON_NET = "Explicit layout + localisation (paper: HorizonNet)"
_ORACLE_QUERY = RowQuery(method="oracle", kind="layout")
_ICP, _ICP_LAYOUT = RowQuery(method="icp"), RowQuery(method="icp", kind="layout")
_WITHOUT_VDR = {"vdr_candidates": 0}


def _paper(columns: Sequence[Column], *figures: float | None) -> dict[Column, float]:
    return {column: figure for column, figure in zip(columns, figures, strict=True) if figure is not None}


def _lalaloc(model: str, kind: QueryKind = "photograph", **query: Any) -> RowQuery:
    return RowQuery(method="lalaloc", model=model, kind=kind, **query)


def _row(group: str, name: str, query: RowQuery, columns: Sequence[Column] = (), *figures: float | None) -> Row:
    """Return a row with the paper's figures by column, none for rows of our own."""
    return Row(group=group, name=name, query=query, paper=_paper(columns, *figures))


def _table(name: str, title: str, source: str, columns: Sequence[Column], *rows: Row) -> Table:
    return Table(name=name, title=title, source=source, split="test", columns=tuple(columns), rows=rows)


def _localisation() -> Table:
    columns = (*_RECALL, *_ACCURACY)
    explicit, decode = (RowQuery(method=method, model=SHIPPED) for method in ("explicit", "decode"))
    explicit_layout, decode_layout = (replace(query, kind="layout") for query in (explicit, decode))
    rows = (
        _row("", _ORACLE, _ORACLE_QUERY, columns, 1.0, 0.911, 20.4, 0.003, 0.0361, 0.135, 0.929),
        _row(_LAYOUT, "2D ICP", _ICP_LAYOUT, columns, None, None, 0.5, 0.879, 0.998, 0.998, 0.999),
        _row(_LAYOUT, "Explicit layout + localisation", explicit_layout),
        _row(_LAYOUT, "VDR + decode, shipped model", decode_layout),
        _row(_LAYOUT, _PAPER, _lalaloc("paper", "layout"), columns, 0.901, 0.874, 0.2, 0.691, 0.824, 0.914, 0.949),
        _row(_LAYOUT, _OURS, _lalaloc(SHIPPED, "layout")),
        _row(_PHOTOGRAPH, _ICP_DEPTH, _ICP, columns, None, None, 21.8, 0.095, 0.264, 0.356, 0.685),
        _row(_PHOTOGRAPH, _HORIZON_NET, explicit, columns, 0.724, 0.680, 9.1, 0.033, 0.293, 0.534, 0.774),
        _row(_PHOTOGRAPH, "VDR + decode, shipped model", decode),
        _row(_PHOTOGRAPH, _PAPER, _lalaloc("paper"), columns, 0.724, 0.706, 8.3, 0.036, 0.320, 0.580, 0.875),
        _row(_PHOTOGRAPH, _OURS, _lalaloc(SHIPPED)),
    )
    return _table("localisation", "Localisation with a floor plan prior", "tab:localisation", columns, *rows)


def _coarse_grid() -> Table:
    columns: tuple[Column, ...] = ("median_cm", "within_1cm", "within_10cm", "within_1m")
    rows = (
        _row("", "Retrieval oracle", _ORACLE_QUERY, columns, 42.7, 0.0, 0.029, 0.757),
        _row(_LAYOUT, "2D ICP", _ICP_LAYOUT, columns, 0.7, 0.769, 0.994, 0.996),
        _row(_LAYOUT, _PAPER, _lalaloc("paper", "layout"), columns, 0.5, 0.561, 0.705, 0.843),
        _row(_LAYOUT, _OURS, _lalaloc(SHIPPED, "layout")),
        _row(_PHOTOGRAPH, _ICP_DEPTH, _ICP, columns, 21.7, 0.073, 0.347, 0.694),
        _row(_PHOTOGRAPH, _PAPER, _lalaloc("paper"), columns, 11.5, 0.026, 0.461, 0.795),
        _row(_PHOTOGRAPH, _OURS, _lalaloc(SHIPPED)),
    )
    coarse = [replace(row, query=replace(row.query, grid_step_m=1.0)) for row in rows]
    return _table("coarse-grid", "Localisation on a 1 m grid", "tab:1m_refinement", columns, *coarse)


def _furniture() -> Table:
    figures = {
        "empty": (2.4, (0.764, 0.740, 5.7)),
        "simple": (10.0, (0.748, 0.733, 6.7)),
        "full": (23.0, (0.724, 0.706, 8.3)),
    }
    rows = []
    for level, (icp, lalaloc) in figures.items():
        group = level.capitalize()
        rows += [
            _row(group, _ICP_DEPTH, RowQuery(method="icp", furniture=level), ("median_cm",), icp),
            _row(group, _PAPER, _lalaloc("paper", furniture=level), _RETRIEVAL, *lalaloc),
            _row(group, _OURS, _lalaloc(SHIPPED, furniture=level)),
        ]
    return _table("furniture", "Level of furniture", "tab:furniture", _RETRIEVAL, *rows)


def _refinement() -> Table:
    columns = ("median_cm", "within_1cm", "within_5cm", "within_10cm")
    figures: list[tuple[str, str | None, MethodName, dict[str, Any], tuple[float, ...]]] = [
        ("Retrieval", "retrieval", "lalaloc", {}, (22.5, 0.003, 0.0319, 0.118)),
        ("VDR only", "vdr", "lalaloc", {}, (11.0, 0.008, 0.151, 0.453)),
        ("LPO only", None, "lalaloc", _WITHOUT_VDR, (10.5, 0.020, 0.274, 0.484)),
        ("VDR + decode", None, "decode", {}, (12.2, 0.005, 0.132, 0.397)),
        ("VDR + LPO", None, "lalaloc", {}, (8.3, 0.036, 0.320, 0.580)),
    ]
    rows = [
        Row(
            group=f"`{model}`",
            name=name,
            query=RowQuery(method=method, model=model, settings=settings),
            stage=stage,
            paper=_paper(columns, *paper) if model == "paper" else {},
        )
        for model in ("paper", SHIPPED)
        for name, stage, method, settings, paper in figures
    ]
    return _table("refinement", "Pose refinement", "tab:refinement", columns, *rows)


def _vogel_samples() -> Table:
    columns = ("median_cm", "within_10cm")
    rows = [
        replace(_row("without VDR", "Retrieval", _lalaloc(SHIPPED)), stage="retrieval"),
        _row("without VDR", "LPO", _lalaloc(SHIPPED, settings=_WITHOUT_VDR)),
    ]
    for samples in (10, 25, 50, 100, 200):
        settings = {} if samples == 200 else {"vdr_samples": samples}
        for name, stage in (("VDR", "vdr"), ("VDR + LPO", None)):
            query = _lalaloc(SHIPPED, settings=settings)
            rows.append(Row(group=f"{samples} samples", name=name, query=query, stage=stage))
    title = "Samples of the Vogel disc, with and without LPO"
    return replace(_table("vogel-samples", title, "fig:vdr_sample", columns, *rows), form="figure")


# By metric: title, and figures of both grids.
_METRICS = {
    "edges": ("Edges", ((0.793, 20.3, 0.836), (0.556, 48.7, 0.592))),
    "depth": ("Depth", ((0.803, 20.1, 0.840), (0.552, 48.3, 0.595))),
    "relative-depth": ("Relative depth", ((0.771, 20.1, 0.854), (0.541, 48.5, 0.616))),
    "chamfer": ("Chamfer *", ((0.908, 20.0, 0.921), (0.718, 42.7, 0.744))),
}
_POSE = ((1.0, 19.8, 1.0), (1.0, 40.1, 0.997))


def _similarity(name: str, source: str, grid_step_m: float, grid: int) -> Table:
    columns = ("pose_recall", "median_cm", "correct_room")
    common: dict[str, Any] = {"kind": "layout", "grid_step_m": grid_step_m}
    rows = [_row("", "Pose (nearest grid pose)", RowQuery(method="pose-oracle", **common), columns, *_POSE[grid])]
    for metric, (title, figures) in _METRICS.items():
        query = RowQuery(method="similarity", settings={"metric": metric}, **common)
        rows.append(_row("", title, query, columns, *figures[grid]))
    return Table(
        name=name,
        title=f"Layout-similarity metric, {grid_step_m:g} m grid",
        source=source,
        split="validation",
        columns=columns,
        rows=tuple(rows),
    )


def _trained(group: str, name: str, model: str, kind: QueryKind, *paper: float) -> Row:
    """Return a row that compares trained models by retrieval alone, as the paper's ablations do."""
    return _row(group, name, _lalaloc(model, kind, settings={"refine": "none"}), _RETRIEVAL, *paper)


def _ablation(name: str, title: str, source: str, *rows: Row) -> Table:
    return Table(name=name, title=title, source=source, split="validation", columns=_RETRIEVAL, rows=rows)


_FAST_PAPER = _lalaloc("paper", settings=_WITHOUT_VDR)
_ORACLE_ON_VALIDATION = _row("", _ORACLE, _ORACLE_QUERY, _RETRIEVAL, 1.0, 0.908, 20.0)

TABLES: tuple[Table, ...] = (
    _localisation(),
    _coarse_grid(),
    _furniture(),
    _refinement(),
    _vogel_samples(),
    _similarity("similarity", "tab:oracle", 0.5, 0),
    _similarity("similarity-coarse", "tab:1m_oracle", 1.0, 1),
    _ablation(
        "training",
        "End-to-end and two-stage training",
        "tab:e2e",
        _trained(_LAYOUT, "End-to-end", "end-to-end", "layout", 0.811, 0.804, 20.9),
        _trained(_LAYOUT, "Two-stage *", "paper", "layout", 0.893, 0.876, 19.9),
        _trained(_PHOTOGRAPH, "End-to-end", "end-to-end", "photograph", 0.244, 0.237, 62.7),
        _trained(_PHOTOGRAPH, "Two-stage *", "paper", "photograph", 0.707, 0.705, 21.7),
    ),
    _ablation(
        "layout-losses",
        "Losses of the layout branch",
        "tab:lalalearning",
        _ORACLE_ON_VALIDATION,
        _trained(_LAYOUT, "log-ratio", "layout-log-ratio", "layout", 0.788, 0.773, 20.5),
        _trained(_LAYOUT, "decode", "layout-decode", "layout", 0.909, 0.846, 20.1),
        _trained(_LAYOUT, "log-ratio + decode *", "paper", "layout", 0.893, 0.876, 19.9),
    ),
    _ablation(
        "layout-architecture",
        "Architecture of the layout branch",
        "tab:layoutarch",
        _trained(_LAYOUT, "ResNet-18, FC *", "paper", "layout", 0.893, 0.876, 19.9),
        _trained(_LAYOUT, "ResNet-50, FC", "layout-resnet50", "layout", 0.875, 0.853, 20.0),
        _trained(_LAYOUT, "ResNet-18, MLP", "layout-mlp", "layout", 0.872, 0.863, 19.9),
    ),
    _ablation(
        "image-losses",
        "Losses of the image branch",
        "tab:rgblearning",
        _ORACLE_ON_VALIDATION,
        _trained(_PHOTOGRAPH, "L2 *", "paper", "photograph", 0.707, 0.705, 21.7),
        _trained(_PHOTOGRAPH, "log-ratio′", "image-log-ratio", "photograph", 0.596, 0.569, 25.1),
        _trained(_PHOTOGRAPH, "L2 + log-ratio′", "image-l2-log-ratio", "photograph", 0.607, 0.599, 24.6),
        _trained(_PHOTOGRAPH, "L2 + distilled log-ratio", "image-l2-kd", "photograph", 0.589, 0.569, 25.0),
    ),
    replace(
        _table(
            "time",
            "Time per stage",
            "tab:time",
            _TIMES,
            _row("", _ICP_DEPTH, _ICP, ("seconds",), 20.1),
            _row("`paper`", "LaLaLoc without VDR", _FAST_PAPER, _TIMES, 0.05, None, 2.33, 2.38),
            _row("`paper`", "LaLaLoc", _lalaloc("paper"), _TIMES, 0.05, 2.87, 1.73, 4.65),
            _row("shipped model", "LaLaLoc without VDR", _lalaloc(SHIPPED, settings=_WITHOUT_VDR)),
            _row("shipped model", "LaLaLoc", _lalaloc(SHIPPED)),
        ),
        form="times",
    ),
)
