"""Effective section profile of a slender body along z, from a linear finite-element solution of its real geometry.

An element of a rod is a straight prism; a notched trunk is not. The section of a layer is therefore chosen such
that its two ends move relative to each other as those of the real body do: end moments, an axial force and a torque
act on the tip face, the mean rigid motion of the cross-section is measured at every station (least squares over points
of its plane), and the layer's EI, EA and GJ follow from the differences.

    python tools/section_profile.py trunk.vtk --robot trunk_physical --necks 6 --extrapolate
    python tools/section_profile.py trunk.vtk --robot trunk_sofa --element P1 --equal-node-masses --stiffening

prints the arrays of a robot file's [body], and compares sag and first modes of the rod with the solid's.
The mesh is in millimetres, its axis is z, its tip face is plane. Needs scikit-fem and pypardiso.
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import skfem
from pypardiso import PyPardisoSolver
from scipy.linalg import eigh
from scipy.sparse import csr_matrix, diags, triu
from scipy.sparse.linalg import LinearOperator, eigsh
from skfem.helpers import dot
from skfem.models.elasticity import lame_parameters, linear_elasticity

from rfdropo_bayes.robots import Robot
from rfdropo_bayes.robots.body import poisson_terms
from rfdropo_bayes.robots.meshes import read_tetrahedra

CLAMP = 0.020  # [m] nodes up to here are held
GRAVITY = 9.81  # [m/s2]
SAMPLE_SPACING = 8e-4  # [m] of the points at which the motion of a cross-section is read
NECK_ZONE = 1.5e-3  # [m] half height of the zone first refined about the middle of a neck
RATIOS = (0.1, 0.3, 0.4, 0.43, 0.47, 0.485, 0.495, 0.499)
SHEAR_FACTOR = 0.89  # of a circle (Cowper, 1966)
BEAM_MASS = np.array([[156, 22, 54, -13], [22, 4, 13, -3], [54, 13, 156, -22], [-13, -3, -22, 4]]) / 420.0
UNITS = {"axial_area": "_m2", "mass_area": "_m2", "poisson_stiffening": ""}
ELEMENTS = {"P1": skfem.ElementTetP1, "P2": skfem.ElementTetP2}


@dataclass(frozen=True)
class Solid:
    """A clamped linear elastic solid with Young's modulus 1 Pa and density 1 kg/m3."""

    coarse: skfem.MeshTet
    basis: skfem.CellBasis
    poisson_ratio: float
    stiffness: csr_matrix
    mass: csr_matrix
    free: np.ndarray
    solve: Callable[[np.ndarray], np.ndarray]

    def displacement(self, force: np.ndarray) -> np.ndarray:
        """Displacement of all degrees of freedom under nodal forces."""
        result = np.zeros(len(force))
        result[self.free] = self.solve(force[self.free])
        return result

    def weight(self, direction: int) -> np.ndarray:
        """Nodal forces of a unit acceleration along an axis."""
        unit = np.zeros(self.basis.N)
        unit[self.basis.nodal_dofs[direction]] = 1.0
        if self.basis.edge_dofs.size:
            unit[self.basis.edge_dofs[direction]] = 1.0
        return self.mass @ unit

    def frequencies(self, number: int) -> np.ndarray:
        """Lowest natural angular frequencies [rad/s]."""
        stiffness, mass = (matrix[self.free][:, self.free] for matrix in (self.stiffness, self.mass))
        inverse = LinearOperator(stiffness.shape, matvec=self.solve, dtype=float)
        start = np.random.default_rng(0).standard_normal(len(self.free))
        values = eigsh(stiffness, number, mass, sigma=0.0, OPinv=inverse, v0=start, return_eigenvectors=False)
        return np.sqrt(np.sort(values))


def read_mesh(path: Path) -> skfem.MeshTet:
    """Read a tetrahedral mesh given in millimetres."""
    mesh = read_tetrahedra(path, "mm")
    return skfem.MeshTet(mesh.position.T, np.ascontiguousarray(mesh.element.T, dtype=np.int64))


def refine_necks(mesh: skfem.MeshTet, station: np.ndarray, passes: int) -> skfem.MeshTet:
    """Bisect, pass by pass, the tetrahedra about the middle of the second, fourth, ... layer, in an ever narrower zone.

    That is where the necks are, and the strain: three passes cut an edge there in half.
    """
    middle = (station[1:-1:2] + station[2::2]) / 2.0
    for step in range(passes):
        reach = max(NECK_ZONE * 0.8**step, NECK_ZONE / 4.0)
        z = mesh.p[2][mesh.t]
        near = (z.min(0)[:, None] < middle + reach) & (z.max(0)[:, None] > middle - reach)
        mesh = mesh.refined(np.flatnonzero(near.any(1)))
    return mesh


def clamp_solid(
    coarse: skfem.MeshTet, fine: skfem.MeshTet, element: str, poisson_ratio: float, equal_node_masses: bool = False
) -> Solid:
    """Discretise and factorise; ``equal_node_masses`` spreads the volume equally over the nodes, as in SOFA's scene."""
    basis = skfem.Basis(fine, skfem.ElementVector(ELEMENTS[element]()), intorder=2)
    stiffness = linear_elasticity(*lame_parameters(1.0, poisson_ratio)).assemble(basis).tocsr()
    if equal_node_masses:
        mass = diags(np.full(basis.N, volume(coarse) / (basis.N // 3))).tocsr()
    else:
        accurate = skfem.Basis(fine, basis.elem, intorder=4)
        mass = skfem.BilinearForm(lambda u, v, w: dot(u, v)).assemble(accurate).tocsr()
    free = np.flatnonzero(basis.doflocs[2] > CLAMP + 1e-9)
    upper = triu(stiffness[free][:, free], format="csr")
    factor = PyPardisoSolver(mtype=2)
    factor.factorize(upper)
    return Solid(coarse, basis, poisson_ratio, stiffness, mass, free, partial(factor.solve, upper))


def corners(mesh: skfem.MeshTet) -> np.ndarray:
    """Corner coordinates (tetrahedron, corner, 3) [m]."""
    return mesh.p.T[mesh.t.T]


def volume(mesh: skfem.MeshTet) -> float:
    """Volume [m3]."""
    corner = corners(mesh)
    return float(np.abs(np.linalg.det(corner[:, 1:] - corner[:, :1])).sum() / 6.0)


def section_points(mesh: skfem.MeshTet, z: float) -> np.ndarray:
    """Points (3, n) on a square grid in the plane z that lie inside the mesh."""
    corner = corners(mesh)
    corner = corner[(corner[:, :, 2].min(1) <= z) & (corner[:, :, 2].max(1) >= z)]
    reach = np.abs(corner[:, :, :2]).max()
    axis = np.arange(-reach, reach + SAMPLE_SPACING, SAMPLE_SPACING)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    points = np.column_stack([grid, np.full(len(grid), z)])
    inverse = np.linalg.inv(corner[:, 1:] - corner[:, :1])
    inside = np.zeros(len(points), bool)
    for origin, matrix in zip(corner[:, 0], inverse, strict=True):
        barycentric = (points - origin) @ matrix
        inside |= (barycentric.min(1) > 1e-9) & (barycentric.sum(1) < 1.0 - 1e-9)
    return points[inside].T


class SectionMotion:
    """Mean rigid motion of the cross-section at a station, as a linear map from the solid's displacements."""

    def __init__(self, solid: Solid, z: float) -> None:
        self.points = section_points(solid.coarse, z)
        x, y = self.points[:2]
        one, zero = np.ones_like(x), np.zeros_like(x)
        along = [one, zero, zero, zero, zero, -y], [zero, one, zero, zero, zero, x], [zero, zero, one, y, -x, zero]
        rigid = np.array(along)
        self.inverse = np.linalg.pinv(rigid.transpose(0, 2, 1).reshape(-1, 6))
        self.probes = solid.basis.probes(self.points)

    def __call__(self, displacement: np.ndarray) -> np.ndarray:
        """Translation and rotation (6,) about the axis."""
        return self.inverse @ (self.probes @ displacement)


def tip_loads(solid: Solid) -> np.ndarray:
    """Nodal forces (4, dofs) of a unit moment about y and x, a unit axial force and a unit torque on the tip face."""
    mesh = solid.basis.mesh
    top = mesh.p[2].max()
    facets = mesh.facets_satisfying(lambda x: x[2] > top - 1e-6, boundaries_only=True)
    face = skfem.FacetBasis(mesh, solid.basis.elem, facets=facets, intorder=3)

    def integral(function: Callable[[np.ndarray], np.ndarray]) -> float:
        return float(skfem.Functional(lambda w: function(w.x)).assemble(face))

    centre = [integral(lambda x, axis=axis: x[axis]) / integral(lambda x: 1.0 + 0 * x[0]) for axis in (0, 1)]
    patterns = (
        lambda x, v: -(x[0] - centre[0]) * v[2],
        lambda x, v: (x[1] - centre[1]) * v[2],
        lambda x, v: v[2],
        lambda x, v: (x[0] - centre[0]) * v[1] - (x[1] - centre[1]) * v[0],
    )
    loads = []
    for pattern in patterns:
        force = skfem.LinearForm(lambda v, w, pattern=pattern: pattern(w.x, v)).assemble(face)
        loads.append(force / resultant(solid, force)[len(loads)])
    return np.array(loads)


def resultant(solid: Solid, force: np.ndarray) -> np.ndarray:
    """Moments about y and x, axial force and torque of nodal forces, about the axis."""
    place = solid.basis.doflocs
    component = np.zeros(solid.basis.N, int)
    for dofs in (solid.basis.nodal_dofs, solid.basis.edge_dofs):
        for axis in range(len(dofs)):
            component[dofs[axis]] = axis % 3
    x, y = place[0], place[1]
    axial, along_y, along_x = (np.where(component == axis, force, 0.0) for axis in (2, 1, 0))
    return np.array([-(x * axial).sum(), (y * axial).sum(), axial.sum(), (x * along_y - y * along_x).sum()])


def effective_sections(solid: Solid, station: np.ndarray) -> dict[str, np.ndarray]:
    """Bending, axial and torsional section constants of every layer [m4, m2, m4]."""
    motions = [SectionMotion(solid, z) for z in station[1:-1]]
    fields = [solid.displacement(load) for load in tip_loads(solid)]
    motion = np.array([[measure(field) for measure in motions] for field in fields])
    step = np.diff(motion, axis=1, prepend=0.0)
    length = np.diff(station)[:-1]
    shear = 1.0 / (2.0 * (1.0 + solid.poisson_ratio))
    found = {
        "axial_area": length / step[2, :, 2],
        "bending_moment_area": np.stack([length / step[0, :, 4], length / step[1, :, 3]], axis=1),
        "torsion_constant": length / step[3, :, 5] / shear,
    }
    last = plain_sections(solid.coarse, station[-2:])
    return {name: np.concatenate([values, last[name]]) for name, values in found.items()}


def plain_sections(mesh: skfem.MeshTet, station: np.ndarray, cuts: int = 24) -> dict[str, np.ndarray]:
    """Section constants of layers without a notch: harmonic means of the sections cut through them.

    The loads act on the last layer's own face, so that its stiffness cannot be read off the solution.
    """
    rows = []
    for low, high in itertools.pairwise(station):
        sections = []
        for z in low + (high - low) * (np.arange(cuts) + 0.5) / cuts:
            x, y = section_points(mesh, z)[:2]
            cell = SAMPLE_SPACING**2
            sections.append([len(x) * cell, (x**2).sum() * cell, (y**2).sum() * cell])
        rows.append(1.0 / np.mean(1.0 / np.array(sections), axis=0))
    mean = np.array(rows)
    return {"axial_area": mean[:, 0], "bending_moment_area": mean[:, 1:], "torsion_constant": mean[:, 1] + mean[:, 2]}


def mass_sections(solid: Solid, station: np.ndarray, equal_node_masses: bool) -> dict[str, np.ndarray]:
    """Volume per length and mass second moments of every layer; of equal node masses if that is how the mass lies."""
    if equal_node_masses:
        place = solid.coarse.p.T
        weight = np.full(len(place), volume(solid.coarse) / len(place))
    else:
        fine = solid.coarse.refined(3)
        corner = corners(fine)
        place = corner.mean(1)
        weight = np.abs(np.linalg.det(corner[:, 1:] - corner[:, :1])) / 6.0
    layer = np.searchsorted(station, place[:, 2], side="right") - 1
    layer[place[:, 2] >= station[-1]] = len(station) - 2
    inside = layer >= 0
    total, xx, yy = (
        np.bincount(layer[inside], (weight * factor)[inside], len(station) - 1) / np.diff(station)
        for factor in (1.0, place[:, 0] ** 2, place[:, 1] ** 2)
    )
    return {"mass_area": total, "mass_moment_area": np.stack([xx, yy], axis=1)}


@dataclass(frozen=True)
class Response:
    """Small motions of a trunk with the given material: sag of the tip, natural frequencies of bending pairs."""

    sag_m: float
    frequency_hz: np.ndarray


def solid_response(solid: Solid, station: np.ndarray, young_modulus: float, density: float) -> Response:
    """Linear sag of the last notch-free station under gravity along -y, and the first two bending frequencies."""
    field = solid.displacement(-GRAVITY * solid.weight(1))
    sag = SectionMotion(solid, station[-2])(field)[1]
    scale = density / young_modulus
    return Response(float(sag * scale), solid.frequencies(4)[::2] / (2 * np.pi * np.sqrt(scale)))


def rod_response(
    station: np.ndarray, profile: dict[str, np.ndarray], poisson_ratio: float, young_modulus: float, density: float
) -> Response:
    """The same of the layers as a chain of Timoshenko beams with consistent mass, bending in the y-z plane."""
    size = 2 * len(station)
    stiffness, mass = np.zeros((size, size)), np.zeros((size, size))
    rigidity = young_modulus * profile["bending_moment_area"][:, 1]
    shear = young_modulus / (2.0 * (1.0 + poisson_ratio)) * SHEAR_FACTOR * profile["axial_area"]
    for layer, length in enumerate(np.diff(station)):
        here = slice(2 * layer, 2 * layer + 4)
        soft = 12.0 * rigidity[layer] / (shear[layer] * length**2)
        stiffness[here, here] += beam_stiffness(length, rigidity[layer], soft)
        mass[here, here] += (
            density
            * profile["mass_area"][layer]
            * length
            * BEAM_MASS
            * np.outer([1.0, length, 1.0, length], [1.0, length, 1.0, length])
        )
    force = -GRAVITY * mass[:, ::2].sum(1)
    displacement = np.linalg.solve(stiffness[2:, 2:], force[2:])
    squared = eigh(stiffness[2:, 2:], mass[2:, 2:], eigvals_only=True, subset_by_index=[0, 1])
    return Response(float(displacement[-4]), np.sqrt(squared) / (2.0 * np.pi))


def beam_stiffness(length: float, rigidity: float, soft: float) -> np.ndarray:
    """Stiffness of a Timoshenko beam: deflection and slope of its ends (Przemieniecki, 1968, ch. 5.6)."""
    scale = np.diag([1.0, length, 1.0, length])
    near, far = 4.0 + soft, 2.0 - soft
    unit = np.array([[12, 6, -12, 6], [6, near, -6, far], [-12, -6, 12, -6], [6, far, -6, near]])
    return rigidity / (length**3 * (1.0 + soft)) * scale @ unit @ scale


@dataclass(frozen=True)
class Discretisation:
    """How the solid is discretised: element, uniform refinements of the mesh, passes of bisection at the necks."""

    element: str = "P2"
    refine: int = 0
    necks: int = 0
    equal_node_masses: bool = False

    def solid(self, mesh: skfem.MeshTet, station: np.ndarray, poisson_ratio: float) -> Solid:
        """The clamped solid."""
        fine = refine_necks(mesh.refined(self.refine) if self.refine else mesh, station, self.necks)
        return clamp_solid(mesh, fine, self.element, poisson_ratio, self.equal_node_masses)


def derive_profile(solid: Solid, station: np.ndarray, equal_node_masses: bool) -> dict[str, np.ndarray]:
    """Effective stiffness and mass of the layers between the stations."""
    return effective_sections(solid, station) | mass_sections(solid, station, equal_node_masses)


def toml_arrays(profile: dict[str, np.ndarray]) -> str:
    """The profile as arrays of a robot file's [body]."""
    lines = []
    for name, values in profile.items():
        rounded = json.dumps(np.vectorize(lambda value: float(f"{value:.4g}"))(values).tolist())
        lines.append(f"{name}{UNITS.get(name, '_m4')} = {rounded}")
    return "\n".join(lines)


def stiffening(
    mesh: skfem.MeshTet, station: np.ndarray, how: Discretisation, reference: float, ratios: tuple[float, ...]
) -> np.ndarray:
    """Coefficients (layer, 3) of the bending stiffness of each layer over that at the reference Poisson ratio.

    See `Body.poisson_stiffening` for the functions they multiply; the relative error is fitted (3 % at most here).
    """

    def bending(ratio: float) -> np.ndarray:
        return effective_sections(how.solid(mesh, station, ratio), station)["bending_moment_area"].mean(1)

    base = bending(reference)
    factor = np.array([bending(ratio) / base for ratio in ratios])
    terms = np.array([poisson_terms(ratio, reference) for ratio in ratios])
    return np.array(
        [np.linalg.lstsq(terms / column[:, None], (column - 1.0) / column, rcond=None)[0] for column in factor.T]
    )


def main() -> None:
    """Print the profile and how the rod compares with the solid."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", type=Path, help="VTK file of tetrahedra, in millimetres")
    parser.add_argument("--robot", default="trunk_physical", help="whose stations are used")
    parser.add_argument("--element", choices=sorted(ELEMENTS), default="P2")
    parser.add_argument("--refine", type=int, default=0, help="uniform refinements of the mesh")
    parser.add_argument("--necks", type=int, default=0, help="passes of bisection about the necks")
    parser.add_argument(
        "--extrapolate", action="store_true", help="from a solution with 3 passes fewer: error ~ edge^2"
    )
    parser.add_argument("--poisson-ratio", type=float, default=0.45)
    parser.add_argument("--equal-node-masses", action="store_true", help="the mass of SOFA's UniformMass")
    parser.add_argument("--stiffening", action="store_true", help="dependence on Poisson's ratio too")
    arguments = parser.parse_args()

    robot = Robot.load(arguments.robot)
    station, ratio = np.array(robot.body.station_m), arguments.poisson_ratio
    mesh = read_mesh(arguments.mesh)
    how = Discretisation(arguments.element, arguments.refine, arguments.necks, arguments.equal_node_masses)
    solid = how.solid(mesh, station, ratio)
    profile = derive_profile(solid, station, how.equal_node_masses)
    shown = profile
    if arguments.extrapolate:
        before = effective_sections(replace(how, necks=how.necks - 3).solid(mesh, station, ratio), station)
        shown = profile | {name: profile[name] + (profile[name] - before[name]) / 3.0 for name in before}
    print(toml_arrays(shown))
    if arguments.stiffening:
        print(toml_arrays({"poisson_stiffening": stiffening(mesh, station, how, ratio, RATIOS)}))
    material = (robot.nominal()["young_modulus"], robot.density(robot.nominal()["trunk_mass"]))
    responses = {
        "solid": solid_response(solid, station, *material),
        "rod": rod_response(station, profile, ratio, *material),
    }
    if arguments.extrapolate:
        responses["rod, extrapolated"] = rod_response(station, shown, ratio, *material)
    print(f"# {solid.basis.N} degrees of freedom")
    for name, response in responses.items():
        modes = " and ".join(f"{value:.4f}" for value in response.frequency_hz)
        print(f"# {name}: sag {1e3 * response.sag_m:.2f} mm at z = {1e3 * station[-2]:.1f} mm, modes {modes} Hz")


if __name__ == "__main__":
    main()
