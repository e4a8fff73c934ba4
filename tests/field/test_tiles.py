"""The table of tiles: skips, order, and the finer grid that follows a surface."""

from __future__ import annotations

import pytest
import torch

from tests.ops.fields import promises
from torch_surfcap.field.tiles import (
    MAX_SKIP,
    TileGrid,
    morton_sorted,
    skips_by_doubling,
    skips_on_host,
    voxel_centers,
    with_skips,
)
from torch_surfcap.ops import INSIDE, OUTSIDE


def test_skips_by_hand() -> None:
    # A row of tiles with one stored, at 4. Cells are pairs t, t + 1, so cells 3 and 4 are not empty; an entry's skip is
    # the distance of its cell to them: 3 at tile 0, 2, 1, then 0 at tile 3, whose cell is not empty; 1, 2 behind.
    table = torch.full((7, 1, 1), OUTSIDE, dtype=torch.int32)
    table[4] = 0
    assert (with_skips(table).flatten() - OUTSIDE).tolist() == [-3, -2, -1, 0, 2, -1, -2]


def test_skips_equal_the_slow_way() -> None:
    g = torch.Generator().manual_seed(0)
    kind = torch.rand(9, 7, 11, generator=g)
    table = torch.where(kind > 0.99, 5, torch.where(kind > 0.98, INSIDE, OUTSIDE)).int()
    assert torch.equal(with_skips(table), promises(table))
    assert torch.equal(with_skips(with_skips(table)), promises(table))


@pytest.mark.parametrize("shape", [(1, 1, 1), (3, 8, 1), (40, 5, 60), (2, 300, 3), (130, 5, 40)])
@pytest.mark.parametrize("share", [0.0, 1e-5, 1e-3, 0.1])
def test_skips_by_doubling(shape: tuple[int, int, int], share: float, device: str) -> None:
    """As scipy's, to the last cell, where one cell or none is marked and where many are."""
    marked = torch.rand(shape, generator=torch.Generator().manual_seed(0)) < share
    if share == 1e-5:
        marked[shape[0] // 2, shape[1] // 3, shape[2] - 1] = True
    found = skips_by_doubling(marked.to(device))
    assert torch.equal(found.cpu().int(), skips_on_host(marked).int())


def test_a_table_on_a_device(device: str) -> None:
    g = torch.Generator().manual_seed(1)
    table = torch.where(torch.rand(30, 20, 40, generator=g) > 0.999, 5, OUTSIDE).int()
    assert torch.equal(with_skips(table.to(device)).cpu(), with_skips(table))


def test_skips_of_nothing() -> None:
    table = torch.full((3, 3, 3), OUTSIDE, dtype=torch.int32)
    assert (with_skips(table) == OUTSIDE - MAX_SKIP).all()


def test_morton_order() -> None:
    """The eight tiles of a 2 x 2 x 2 block follow one another, block by block."""
    coords = torch.cartesian_prod(*[torch.arange(4, dtype=torch.int32)] * 3)
    shuffled = coords[torch.randperm(64, generator=torch.Generator().manual_seed(0))]
    blocks = (morton_sorted(shuffled) // 2).view(8, 8, 3)
    assert (blocks == blocks[:, :1]).all()
    assert sorted(map(tuple, morton_sorted(shuffled).tolist())) == sorted(map(tuple, coords.tolist()))


def grid_of(stored: list[tuple[int, int, int]], inside: list[tuple[int, int, int]] | None = None) -> TileGrid:
    marks = torch.zeros(2, 4, 3, 5, dtype=torch.bool)
    for i, places in enumerate((stored, inside or [])):
        for place in places:
            marks[i][place] = True
    return TileGrid.build(marks[0], marks[1], (1.0, 2.0, 3.0), 0.5)


def test_build() -> None:
    grid = grid_of([(1, 2, 3), (0, 0, 0)], [(1, 1, 1), (1, 2, 3)])
    assert grid.size == (4, 3, 5)
    assert grid.coords.tolist() == [[0, 0, 0], [1, 2, 3]]
    assert grid.table[1, 1, 1] == 0
    assert grid.table[2, 3, 4] == 1  # stored wins over inside
    assert grid.table[2, 2, 2] == INSIDE
    assert ((grid.table == INSIDE) | (grid.table <= OUTSIDE) | (grid.table >= 0)).all()
    border = torch.ones_like(grid.table, dtype=torch.bool)
    border[1:-1, 1:-1, 1:-1] = False
    assert (grid.table[border] <= OUTSIDE).all()
    assert grid.frame(1.0, 0.0) == [-1.0, 0.0, 1.0, 0.5, 1.0, 0.0]  # a tile of 4 * 0.5 before the origin
    assert voxel_centers(grid)[1, 0, 1, 2].tolist() == [1 + 2 + 0.25, 2 + 4 + 0.75, 3 + 6 + 1.25]


def test_refined_follows_the_surface() -> None:
    # Tile (1, 1, 2) with a surface in its voxel (1, 1, 1) alone, coarse voxel (5, 5, 9): it and its neighbours (4..6,
    # 4..6, 8..10) lie in fine tiles 2..3 x 2..3 x 4..5.
    grid = grid_of([(1, 1, 2)], [(3, 2, 4)])
    surface = torch.zeros(1, 4, 4, 4, dtype=torch.bool)
    surface[0, 1, 1, 1] = True
    solid = torch.zeros_like(surface)
    fine = grid.refined(surface, solid)
    assert fine.voxel_size == 0.25
    assert fine.size == (8, 6, 10)
    expected = torch.cartesian_prod(torch.tensor([2, 3]), torch.tensor([2, 3]), torch.tensor([4, 5]))
    assert sorted(fine.coords.tolist()) == expected.tolist()
    assert fine.inside[6:8, 4:6, 8:10].all()  # under the coarse inside tile
    assert fine.inside.sum() == 8


def test_refined_takes_the_solid_for_inside() -> None:
    grid = grid_of([(1, 1, 2)])
    surface, solid = torch.zeros(2, 1, 4, 4, 4, dtype=torch.bool)
    solid[0, :2] = True  # the low half in x: four of the eight fine tiles
    fine = grid.refined(surface, solid)
    assert len(fine.coords) == 0
    assert fine.inside[2, 2:4, 4:6].all()
    assert fine.inside.sum() == 4


def test_borders_equal_the_slow_way() -> None:
    """A voxel lies on the border if a 6-neighbour is on the other side, whichever tile that one lies in or misses."""
    g = torch.Generator().manual_seed(0)
    stored = torch.rand(3, 4, 2, generator=g) > 0.4
    inside = ~stored & (torch.rand(3, 4, 2, generator=g) > 0.5)
    grid = TileGrid.build(stored, inside, (0.0, 0.0, 0.0), 1.0)
    within = torch.rand(len(grid.coords), 4, 4, 4, generator=g) > 0.2
    dense = torch.zeros(14, 18, 10, dtype=torch.bool)  # with a border of one voxel, which is outside
    inner = dense[1:-1, 1:-1, 1:-1].view(3, 4, 4, 4, 2, 4).permute(0, 2, 4, 1, 3, 5)
    inner[inside] = True
    i, j, k = grid.coords.long().unbind(1)
    inner[i, j, k] = within
    crossed = torch.zeros_like(dense)
    for axis in range(3):
        differs = dense.diff(dim=axis)
        crossed.narrow(axis, 0, differs.shape[axis]).logical_or_(differs)
        crossed.narrow(axis, 1, differs.shape[axis]).logical_or_(differs)
    expected = crossed[1:-1, 1:-1, 1:-1].view(3, 4, 4, 4, 2, 4).permute(0, 2, 4, 1, 3, 5)[i, j, k]
    assert expected.any()
    assert not expected.all()
    assert torch.equal(grid.borders(within), expected)
