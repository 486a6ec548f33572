"""What a frame works out at the nodes of patches: their light (Gouraud), their normals by a table; paper, section 3."""

from dataclasses import dataclass

import numpy as np

from ..device import Device, DeviceArray
from ..errors import InputError
from ..surface.arrays import lengths_of
from ..surface.patch import PatchSurface
from .normal_table import SIDE, TABLE_BYTES, ratio_groups, table_order
from .tiles import Scratch

LIT_RANGE = 4.0  # lit colours may exceed 1: gloss, several lamps
LIT_UNIT = f"(-{LIT_RANGE:.1f}f / 65535.0f)"  # negative: the planes' mark of what is lit
UNIT = 32767  # of the components in the table: kernels/render/table_normals.cl


def light_nodes(device: Device, scratch: Scratch, upload, constants: dict, view: DeviceArray, lamps: DeviceArray,
                rectangles: DeviceArray) -> DeviceArray:
    """Return the nodes (N, 4) uint32 of all patches in the picture with lit colours, in units of -`LIT_UNIT`."""
    lit = scratch.array("lit_nodes", upload.nodes.shape, np.uint32)
    group = 64 if scratch.lanes == 1 else 1
    constants = constants | {"VW": scratch.lanes, "LIT_RANGE": f"{LIT_RANGE:.1f}f"}
    device.kernel("render/light_nodes.cl", constants=constants)(
        (upload.count * group,), (group,), view, lamps, rectangles, upload.frames, upload.sizes, upload.offsets,
        upload.count, upload.nodes, lit)
    return lit


@dataclass(frozen=True, eq=False)
class TableGroups:
    """The patches of a surface by their axis ratios, on a device."""

    number: int  # groups
    groups: DeviceArray  # (p,) int32
    ratios: DeviceArray  # (number, 2) float32
    order: DeviceArray  # (p,) int32: as they come
    ordered: DeviceArray  # (p,) int32: by group
    precomputed: DeviceArray | None  # (SIDE, SIDE, 4) uint16, where there is one group


def table_groups(device: Device, surface: PatchSurface) -> TableGroups:
    """Upload what the table of normals needs to know of a surface."""
    group, ratios = ratio_groups(surface)
    table = None
    if len(ratios) == 1:
        x, y = (np.arange(SIDE) * 0.5 * r for r in ratios[0].astype(np.float32).astype(np.float64))
        normals = np.stack([*np.broadcast_arrays(x[:, None], y[None], 1.0)], axis=-1)
        normals *= UNIT / lengths_of(normals, keepdims=True)
        table = device.upload(np.concatenate([np.floor(normals + 0.5), np.ones((SIDE, SIDE, 1))], axis=-1), np.uint16)
    return TableGroups(len(ratios), device.upload(group, np.int32), device.upload(ratios, np.float32),
                       device.upload(np.arange(len(group)), np.int32), device.upload(table_order(group), np.int32),
                       table)


def table_normals(device: Device, scratch: Scratch, upload, constants: dict, rectangles: DeviceArray, mode,
                  parts: int | None = None) -> tuple[DeviceArray, DeviceArray]:
    """Look the normals of all patches in the picture up in a table; see `PatchDrawing.normal_table`.

    Parameters
    ----------
    mode : True, "ordered" or "precomputed"
    parts : int, optional
        Work-items, each with a table; by default one per compute unit.

    Returns
    -------
    nodes : (N, 4) uint32
        With the slopes that the table gives.
    counts : (parts, 2) uint32
        Normals wanted and computed by each work-item.

    Raises
    ------
    InputError
        32-bit displacements, or "precomputed" where the patches differ in their axis ratios.
    """
    if upload.precise:
        raise InputError("patches normal_table: expected 8-bit displacements, got 32-bit ones: leave it out")
    groups = upload.once("table_groups", lambda surface: table_groups(device, surface))
    precomputed = mode == "precomputed"
    if precomputed and groups.precomputed is None:
        raise InputError(f"patches normal_table: expected patches of equal |a_z| / |a_x| and |a_z| / |a_y| for "
                         f"'precomputed', got {groups.number} different ones: use 'ordered'")
    parts = min(device.units if parts is None else parts, upload.count)
    tables = groups.precomputed
    if not precomputed:
        device.check_memory(tables=TABLE_BYTES * parts)
        tables = scratch.array("normal_tables", (parts, SIDE, SIDE, 4), np.uint16)
        device.fill(tables, 0)
    nodes = scratch.array("table_nodes", upload.nodes.shape, np.uint32)
    counts = scratch.array("table_counts", (parts, 2), np.uint32)
    device.fill(counts, 0)
    device.kernel("render/table_normals.cl", constants=constants | {"PRECOMPUTED": precomputed})(
        (parts,), (1,), rectangles, upload.sizes, upload.offsets, upload.count,
        groups.ordered if mode == "ordered" else groups.order, groups.groups, groups.ratios,
        -(-upload.count // parts), upload.heights, upload.colors, upload.nodes, tables, nodes, counts)
    return nodes, counts
