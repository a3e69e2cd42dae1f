"""The linear system of a stage with its constraints: solved on lanes, with derivatives by the solution's own equations.

A stage finds the change d of velocities and spins, and the impulses g of all constraints, from

    A d = r + J' g,    g = P(J (v + d) + b)

All expensive operations run on lanes of a batch (``lanes``). A derivative takes one more right-hand side of the
factorised system: the change of the equations' residual with the inputs, at a constant solution. Reverse mode uses the
transposed system.

Symmetric positive definite systems along a chain of stations with six unknowns each: Cholesky's factor, written out
by components, with a batch in the last axis (``lanes``).

Matrices come as the stiffness of the elements between stations and the inertia at stations. Blocks are assembled during
elimination, which saves memory traffic.

The constraint problem of cables alone, on lanes of a batch: a complementarity problem, solved by its active set.

With cables only, Newton's step of ``constraints`` is the solution of R g + W g = -b over the cables that pull. It is
the answer if these cables are the same after it. Most steps have the same active set as the step before. Otherwise
Newton's method continues from the impulses of that step, with the line search of `fem.constraints`.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rfdropo_bayes.fem import rod_elements
from rfdropo_bayes.fem.cables import (
    CableLayout,
    Courses,
    TautCables,
    Threads,
    courses,
    lengths,
    pull_beside,
    station_rows,
    taut_cables,
)
from rfdropo_bayes.fem.components import (
    Matrix,
    Quaternion,
    Vector,
    cross,
    diagonal,
    product,
    rotation,
    times,
    transposed,
    transposed_times,
)
from rfdropo_bayes.fem.constraints import (
    HALVINGS,
    ITERATIONS,
    TOLERANCE,
    Contacts,
    Problem,
    Slips,
    answers,
    posed,
    settle,
    slope_matrix,
)
from rfdropo_bayes.fem.derivatives import pushed_forward
from rfdropo_bayes.fem.effects import Scalar
from rfdropo_bayes.fem.lanes import laned
from rfdropo_bayes.fem.rod_elements import Elements, Six, Stiffness
from rfdropo_bayes.fem.sections import Sections, answer, linear, slopes


class _Iterate(NamedTuple):
    impulse: Float[Array, "n ..."]
    active: Bool[Array, "n ..."]  # cables that are taken to pull
    found: Bool[Array, " ..."]
    iteration: Int[Array, ""]


SIZE = 6


class Chain(NamedTuple):
    """A symmetric block-tridiagonal matrix."""

    element: Stiffness
    straight: Matrix  # of the translations of a station
    turning: Matrix  # of its rotations


class Factor(NamedTuple):
    """A = C C', with C lower block-bidiagonal."""

    pivot: Float[Array, "stations 6 6 ..."]  # lower triangles of C's diagonal blocks, their diagonals inverted
    coupling: Float[Array, "stations 6 6 ..."]  # transposed blocks below the diagonal; zero at the first station


class Eliminated(NamedTuple):
    """Result of the elimination."""

    factor: Factor
    solved: Float[Array, "stations 6 ..."]  # y = C^-1 times the right-hand side
    columns: Float[Array, "stations 6 rows ..."]  # Y = C^-1 J'
    compliance: Float[Array, "rows rows ..."]  # Y' Y = J A^-1 J'
    reached: Float[Array, "rows ..."]  # Y' y
    moving: Float[Array, "rows ..."]  # J times the velocities


class StageBody(NamedTuple):
    """A rod in a stage; arrays have their components first."""

    length: Float[Array, "elements ..."]  # [m]
    section: Sections
    mass: Float[Array, "stations ..."]  # [kg]
    inertia: Float[Array, "3 stations ..."]  # about the sections' axes [kg m2]
    position: Vector  # points at which forces are taken [m]
    orientation: Quaternion
    twist: Six  # velocities and spins at the start of the stage
    load: Six  # forces and moments besides [N], [N m]
    span: Scalar  # p [s]
    lookahead: Scalar  # [s] times the tangent times the change of velocity is the change of force
    behind: Scalar  # [s] of strain rates in the force
    loss: Scalar  # Rayleigh's mass damping [1/s]
    carried: Six | None = None  # impulses [N s] with which the motion goes on
    added: Matrix | None = None  # to the matrix, of translations [kg]
    gain: Scalar | None = None  # stiffness of a Prony branch, relative
    branch: Six | None = None  # strains of its dashpot
    blown: Six | None = None  # forces and moments that chambers take from the sections [N], [N m]
    turning: Six | None = None  # forces and moments between the stations that turn, in an equilibrium's matrix


class Bonds(NamedTuple):
    """Constraints of a stage: cables, then friction along them, then contacts."""

    thread: Threads
    reach: Float[Array, " cables"]  # commanded lengths [m]
    previous: Float[Array, " cables"]  # impulses that the iterations start from [N s]
    give: Scalar  # of every cable's length per tension [m/N]
    follows: Scalar  # length of the stage for variables with memory [s]
    rows: Float[Array, "stations 6 others"] | None = None  # of friction and contacts
    base: Float[Array, " others"] | None = None  # velocities in these rows besides the body's
    compliance: Float[Array, "others others"] | None = None  # in these rows besides the body's
    slips: Slips | None = None
    contacts: Contacts | None = None


class Way(NamedTuple):
    """Static settings: number of clamped stations, whether forces are at the predicted position, and the cables."""

    clamped: int
    predicted: bool
    layout: CableLayout


class Solution(NamedTuple):
    """Solution of a stage."""

    change: Float[Array, "6 stations"]  # of velocities and spins; zero at clamped stations
    impulse: Float[Array, " rows"]  # of all constraints [N s]
    converged: Float[Array, ""]  # 1 if the impulses were found, else 0


class Linearised(NamedTuple):
    """A stage's equations without constraints."""

    elements: Elements
    slope: Sections
    frame: Matrix  # of the stations
    course: Courses  # of the cables
    taut: TautCables  # of the elements between them
    right: Six
    pull: Six | None = None  # of the cables beside the elements, of an equilibrium


class Kept(NamedTuple):
    """Data for derivatives of the solution."""

    factor: Factor
    columns: Float[Array, "stations 6 rows"]  # C^-1 J'
    system: Float[Array, "rows rows"]  # 1 + G W
    slope: Float[Array, "rows rows"]  # G
    problem: Problem


def inertia_times(body: StageBody, frame: Matrix, twist: Six) -> Six:
    """Momentum and spin about the stations' centres."""
    turning = times(frame, body.inertia * transposed_times(frame, twist[3:]))
    return jnp.concatenate([body.mass * twist[:3], turning])


def linearised(way: Way, body: StageBody, thread: Threads, tension: Float[Array, "cables ..."]) -> Linearised:
    """The right-hand side of a stage, and the parts of its matrix, at the tensions [N] of the previous stage."""
    frame = rotation(body.orientation)
    course = courses(way.layout, thread, body.position, frame)
    between = taut_cables(way.layout, course, tension, len(body.length))
    elements = rod_elements.shape(body.length, body.position, body.orientation, body.section.inner)
    slope = slopes(body.section, elements.strain)
    rates = rod_elements.strain_rates(elements, body.twist)
    resultant = answer(body.section, elements.strain) + body.behind * linear(slope, rates)
    if body.branch is not None and body.gain is not None:
        resultant = resultant + body.gain * linear(body.section, elements.strain - body.branch)
    if body.blown is not None:
        resultant = resultant - body.blown
    resultant = rod_elements.leant(elements, resultant)
    if not way.predicted:
        resultant = resultant + body.span * rod_elements.taut_resultant(elements, between, rates)
    momentum = inertia_times(body, frame, body.twist)
    force = rod_elements.station_forces(elements, resultant) + body.load - body.loss * momentum
    gyroscopic = cross(body.twist[3:], momentum[3:])
    right = body.span * (force - jnp.concatenate([jnp.zeros_like(gyroscopic), gyroscopic]))
    if body.carried is not None:
        right = right + body.carried
    pull = None if body.turning is None else pull_beside(way.layout, course, tension, body.length)
    return Linearised(elements, slope, frame, course, between, right, pull)


def stresses(body: StageBody, change: Six) -> Six:
    """Forces and moments of the sections after a change of all stations, linear in it."""
    elements = rod_elements.shape(body.length, body.position, body.orientation, body.section.inner)
    rates = rod_elements.strain_rates(elements, change)
    found = answer(body.section, elements.strain) + linear(slopes(body.section, elements.strain), rates)
    return rod_elements.leant(elements, found if body.blown is None else found - body.blown)


def matrix_times(body: StageBody, line: Linearised, change: Six) -> Six:
    """A times a field."""
    rates = rod_elements.strain_rates(line.elements, change)
    strained = rod_elements.leant(line.elements, body.lookahead * linear(line.slope, rates))
    strained = strained + body.span * rod_elements.taut_resultant(line.elements, line.taut, rates)
    stiff = -body.span * rod_elements.station_forces(line.elements, strained)
    result = stiff + (1.0 + body.span * body.loss) * inertia_times(body, line.frame, change)
    if body.added is None:
        return result
    around = times(body.added, change[:3])
    return result + jnp.concatenate([around, jnp.zeros_like(around)])


def matrix(body: StageBody, line: Linearised) -> Chain:
    """A."""
    scale = body.span * body.lookahead
    taut = TautCables(*(body.span**2 * part for part in line.taut))
    stretch, bending = scale * line.slope.stretch, scale * line.slope.bending
    if body.turning is not None:
        axial = body.turning[2]
        bow, none = axial * body.length**2 / 12.0, jnp.zeros_like(axial)
        bow = jnp.stack([bow, bow, none])
        stretch = stretch + jnp.stack([*(2.0 * axial * body.section.inner.shear), none])
        bending = bending + (bow if bending.ndim == bow.ndim else diagonal(bow))
    element = rod_elements.tangent(line.elements, stretch, bending, taut)
    if body.turning is not None and line.pull is not None:
        element = rod_elements.turning(line.elements, element, body.turning, line.pull)
    grown = 1.0 + body.span * body.loss
    straight = jnp.eye(3).reshape(3, 3, *[1] * body.mass.ndim) * (grown * body.mass)
    if body.added is not None:
        straight = straight + body.added
    turning = product(line.frame * (grown * body.inertia)[None], transposed(line.frame))
    return Chain(element, straight, turning)


def all_rows(way: Way, body: StageBody, bonds: Bonds, course: Courses) -> tuple[Array, Array]:
    """J of all constraints (stations, 6, rows), and the lengths of the cables [m]."""
    rows = -station_rows(way.layout, bonds.thread, course.lever, course.pull, body.mass.shape[0])
    if bonds.rows is not None:
        rows = jnp.concatenate([rows, bonds.rows], axis=2)
    return rows, lengths(course)


def along(rows: Float[Array, "stations 6 rows"], twist: Six) -> Float[Array, " rows"]:
    """J times velocities."""
    return jnp.einsum("sir,is->r", rows, twist)


def free_velocities(
    way: Way, body: StageBody, bonds: Bonds, moving: Float[Array, "rows ..."], reached: Float[Array, "cables ..."]
) -> Float[Array, "rows ..."]:
    """b: velocities of the constraints at the start of the stage, cables with their remaining lengths."""
    cables = len(reached)
    slack = (bonds.reach - reached) / body.span
    free = slack if way.predicted else moving[:cables] + slack
    return free if bonds.base is None else jnp.concatenate([free, moving[cables:] + bonds.base])


def _condense(way: Way, body: StageBody, bonds: Bonds) -> tuple[Eliminated, Float[Array, "rows ..."]]:
    """Elimination, and the velocities of the constraints without them; on lanes."""
    line = linearised(way, body, bonds.thread, bonds.previous / body.span)
    rows, reached = all_rows(way, body, bonds, line.course)
    eliminated = eliminate(matrix(body, line), line.right, rows, body.twist, way.clamped)
    return eliminated, free_velocities(way, body, bonds, eliminated.moving, reached) + eliminated.reached


def _project(factor: Factor, columns: Array, right: Six) -> tuple[Array, Array]:
    """C^-1 times a right-hand side, and J A^-1 times it; on lanes."""
    return descend(factor, columns, jnp.moveaxis(right, 1, 0))


def _finish(factor: Factor, solved: Array, columns: Array, impulse: Array) -> Six:
    """The solution from C^-1 times its right-hand side without impulses; on lanes."""
    pulled = sum((columns[:, :, row] * impulse[row] for row in range(columns.shape[2])), solved)
    return jnp.moveaxis(ascend(factor, pulled), 0, 1)


def _padded(free: Six, clamped: int) -> Six:
    return jnp.concatenate([jnp.zeros_like(free[:, :1])] * clamped + [free], axis=1)


def _problem(bonds: Bonds, span: Scalar, compliance: Array) -> Problem:
    cables = len(bonds.previous)
    compliance = compliance.at[jnp.arange(cables), jnp.arange(cables)].add(bonds.give / span**2)
    if bonds.compliance is not None:
        compliance = compliance.at[cables:, cables:].add(bonds.compliance)
    return posed(compliance, cables, bonds.follows, bonds.slips, bonds.contacts)


def _solve(way: Way, body: StageBody, bonds: Bonds) -> tuple[Solution, Kept]:
    eliminated, free = laned(partial(_condense, way))(body, bonds)
    problem = _problem(bonds, body.span, eliminated.compliance)
    if bonds.rows is None:
        impulse, converged = laned(settle_cables)(problem.compliance, free, problem.softness, bonds.previous)
    else:
        others = [jnp.zeros(len(problem.slips.impulse)), problem.contacts.before.ravel()]
        impulse, converged = settle(problem, free, jnp.concatenate([bonds.previous, *others]))
    factor, columns = eliminated.factor, eliminated.columns
    change = laned(_finish)(factor, eliminated.solved, columns, impulse)
    slope = slope_matrix(answers(problem, free + problem.compliance @ impulse))
    system = jnp.eye(len(impulse)) + slope @ problem.compliance
    solution = Solution(_padded(change, way.clamped), impulse, jnp.asarray(converged, float))
    return solution, Kept(factor, columns, system, slope, problem)


def _lacking(way: Way, solution: Solution, kept: Kept, body: StageBody, bonds: Bonds) -> tuple[Array, Array]:
    """Residuals of a stage's equations at a solution, as functions of the inputs."""
    line = linearised(way, body, bonds.thread, bonds.previous / body.span)
    rows, reached = all_rows(way, body, bonds, line.course)
    pulled = jnp.einsum("sir,r->is", rows, solution.impulse)
    forces = matrix_times(body, line, solution.change) - line.right - pulled
    cables = len(bonds.previous)
    velocity = free_velocities(way, body, bonds, along(rows, body.twist), reached) + along(rows, solution.change)
    velocity = velocity.at[:cables].add(bonds.give / body.span**2 * solution.impulse[:cables])
    problem = kept.problem._replace(time_step=bonds.follows)
    if bonds.compliance is not None:
        velocity = velocity.at[cables:].add(bonds.compliance @ solution.impulse[cables:])
    if bonds.slips is not None:
        problem = problem._replace(slips=bonds.slips)
    if bonds.contacts is not None:
        problem = problem._replace(contacts=bonds.contacts)
    return forces[:, way.clamped :], solution.impulse - answers(problem, velocity)[0]


def _linear_solve(kept: Kept, forces: Array, impulses: Array) -> tuple[Array, Array]:
    """Solution of A d - J' g = forces, g + G (J d + ...) = impulses; in reverse, of the transposed system."""
    factor, columns, system, slope = kept[:4]

    def solve(_: Any, right: tuple[Array, Array]) -> tuple[Array, Array]:
        solved, reached = laned(_project)(factor, columns, right[0])
        impulse = jnp.linalg.solve(system, right[1] - slope @ reached)
        return laned(_finish)(factor, solved, columns, impulse), impulse

    def transpose_solve(_: Any, right: tuple[Array, Array]) -> tuple[Array, Array]:
        solved, reached = laned(_project)(factor, columns, right[0])
        impulse = jnp.linalg.solve(system.T, right[1] + reached)
        return laned(_finish)(factor, solved, columns, -slope.T @ impulse), impulse

    # The operator itself is asked for its shape only, as nothing in it has a derivative.
    return lax.custom_linear_solve(lambda x: x, (forces, impulses), solve, transpose_solve, symmetric=True)


def solve_stage(way: Way, body: StageBody, bonds: Bonds) -> Solution:
    """Change of velocities and impulses of a stage."""

    @jax.custom_jvp
    def solution(body: StageBody, bonds: Bonds) -> Solution:
        return _solve(way, body, bonds)[0]

    def rule(primals: Any, tangents: Any) -> tuple[Solution, Solution]:
        reached, kept = lax.stop_gradient(_solve(way, *primals))
        lacking = partial(_lacking, way, reached, kept)
        forces, impulses = pushed_forward(lacking, primals, tangents)
        change, impulse = _linear_solve(kept, -forces, -impulses)
        return reached, Solution(_padded(change, way.clamped), impulse, jnp.zeros_like(reached.converged))

    solution.defjvp(rule, symbolic_zeros=True)
    return solution(body, bonds)


def solved_stage(way: Way, body: StageBody, bonds: Bonds) -> tuple[Solution, Float[Array, " cables"]]:
    """`solve_stage` without derivatives, and the softness of the cables' constraints."""
    solution, kept = _solve(way, body, bonds)
    return solution, kept.problem.softness


def _triangle(block: Any) -> Array:
    """Cholesky's factor of a block, the diagonal inverted."""
    none = jnp.zeros_like(block[0, 0])
    rows: list[list[Any]] = [[none] * SIZE for _ in range(SIZE)]
    for k in range(SIZE):
        rows[k][k] = lax.rsqrt(block[k, k] - sum(rows[k][z] * rows[k][z] for z in range(k)))
        for r in range(k + 1, SIZE):
            rows[r][k] = (block[r, k] - sum(rows[r][z] * rows[k][z] for z in range(k))) * rows[k][k]
    return jnp.stack([jnp.stack(row) for row in rows])


def _down(triangle: Any, right: Any) -> Array:
    """Solve with a triangle."""
    rows: list[Any] = []
    for r in range(SIZE):
        rows.append((right[r] - sum(triangle[r, z] * rows[z] for z in range(r))) * triangle[r, r])
    return jnp.stack(rows)


def _up(triangle: Any, right: Any) -> Array:
    """Solve with a transposed triangle."""
    rows: list[Any] = [None] * SIZE
    for r in reversed(range(SIZE)):
        rows[r] = (right[r] - sum(triangle[z, r] * rows[z] for z in range(r + 1, SIZE))) * triangle[r, r]
    return jnp.stack(rows)


def _at(values: Any, index: Array) -> Any:
    """Entries of the third axis."""
    return jax.tree.map(lambda part: lax.dynamic_index_in_dim(part, index, 2, keepdims=False), values)


def _block(one: Matrix, two: Matrix, three: Matrix, four: Matrix) -> Float[Array, "6 6 ..."]:
    return jnp.concatenate([jnp.concatenate([one, two], axis=1), jnp.concatenate([three, four], axis=1)])


def eliminate(
    chain: Chain,
    right: Float[Array, "6 stations ..."],
    rows: Float[Array, "stations 6 rows ..."],
    twist: Float[Array, "6 stations ..."],
    clamped: int,
) -> Eliminated:
    """Factorise and go down with a right-hand side and the rows J of constraints, over the stations that are free."""
    stations, many, lanes = right.shape[1], rows.shape[2], right.shape[-1]

    def one(before: Any, here: tuple[Array, Array]) -> tuple[Any, Any]:
        triangle, solved, columns, compliance, reached, moving = before
        index, row = here
        element = _at(chain.element, index - 1)
        below = jax.tree.map(lambda part: jnp.where(index > 0, part, 0.0), element) if clamped == 0 else element
        above = jax.tree.map(lambda part: jnp.where(index < stations - 1, part, 0.0), _at(chain.element, index))
        mixed = below.b - above.a
        straight = below.c + above.c + _at(chain.straight, index)
        turning = below.bb + above.aa + _at(chain.turning, index)
        block = _block(straight, mixed, transposed(mixed), turning)
        coupled = _block(-below.c, -below.b, transposed(below.a), transposed(below.ba))
        coupling = jnp.where(index > clamped, _down(triangle, coupled), 0.0)
        triangle = _triangle(block - sum(coupling[z][:, None] * coupling[z][None] for z in range(SIZE)))
        force = lax.dynamic_index_in_dim(right, index, 1, keepdims=False)
        speed = lax.dynamic_index_in_dim(twist, index, 1, keepdims=False)
        solved = _down(triangle, force - sum(coupling[z] * solved[z] for z in range(SIZE)))
        across = sum(coupling[z][:, None] * columns[z][None] for z in range(SIZE))
        columns = _down(triangle, row - across)
        compliance = compliance + sum(column[:, None] * column[None] for column in columns)
        reached = reached + sum(column * value for column, value in zip(columns, solved, strict=True))
        moving = moving + sum(row[z] * speed[z] for z in range(SIZE))
        return (triangle, solved, columns, compliance, reached, moving), (triangle, coupling, solved, columns)

    none = jnp.zeros((many, lanes))
    first = (
        jnp.ones((SIZE, SIZE, lanes)),
        jnp.zeros((SIZE, lanes)),
        jnp.zeros((SIZE, many, lanes)),
        jnp.zeros((many, many, lanes)),
        none,
        none,
    )
    along = jnp.arange(clamped, stations), rows[clamped:]
    last, (pivot, coupling, solved, columns) = lax.scan(one, first, along)
    return Eliminated(Factor(pivot, coupling), solved, columns, *last[3:])


def descend(
    factor: Factor, columns: Float[Array, "stations 6 rows ..."], right: Float[Array, "stations 6 ..."]
) -> tuple[Float[Array, "stations 6 ..."], Float[Array, "rows ..."]]:
    """y = C^-1 times a right-hand side, and Y' y."""

    def one(before: tuple[Array, Array], here: tuple[Array, ...]) -> tuple[Any, Array]:
        solved, total = before
        triangle, coupling, others, values = here
        solved = _down(triangle, values - sum(coupling[z] * solved[z] for z in range(SIZE)))
        return (solved, total + sum(others[z] * solved[z] for z in range(SIZE))), solved

    start = jnp.zeros_like(right[0]), jnp.zeros_like(columns[0, 0])
    (_, total), solved = lax.scan(one, start, (factor.pivot, factor.coupling, columns, right))
    return solved, total


def ascend(factor: Factor, right: Float[Array, "stations 6 ..."]) -> Float[Array, "stations 6 ..."]:
    """C'^-1 times a right-hand side."""

    def one(after: tuple[Array, Array], here: tuple[Array, Array, Array]) -> tuple[Any, Array]:
        solved, coupling = after
        triangle, own, values = here
        solved = _up(triangle, values - sum(coupling[:, k] * solved[k] for k in range(SIZE)))
        return (solved, own), solved

    start = jnp.zeros_like(right[0]), jnp.zeros_like(factor.coupling[0])
    return lax.scan(one, start, (factor.pivot, factor.coupling, right), reverse=True)[1]


def _solved(matrix: Float[Array, "n n ..."], right: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """Solution with a positive definite matrix, by elimination above and below each pivot."""
    whole = jnp.concatenate([matrix, right[:, None]], axis=1)

    def sweep(index: Array, whole: Array) -> Array:
        row, column = whole[index], whole[:, index]
        row = row / row[index]
        swept = whole - column[:, None] * row[None]
        return lax.dynamic_update_index_in_dim(swept, row, index, 0)

    return lax.fori_loop(0, len(right), sweep, whole)[:, -1]


def settle_cables(
    compliance: Float[Array, "n n ..."],
    free: Float[Array, "n ..."],
    softness: Float[Array, "n ..."],
    start: Float[Array, "n ..."],
) -> tuple[Float[Array, "n ..."], Float[Array, " ..."]]:
    """Impulses, and 1 if the solve succeeded."""
    size, lanes = free.shape
    if not size:
        return jnp.zeros((0, lanes)), jnp.ones(lanes)
    usable = jnp.isfinite(softness)
    soft = jnp.where(usable, softness, 1.0)
    eye = jnp.eye(size)[:, :, None]

    def product(impulse: Array) -> Array:
        return sum((compliance[:, k] * impulse[k] for k in range(1, size)), compliance[:, 0] * impulse[0])

    def pulling(velocity: Array) -> Array:
        return usable & (velocity < 0.0)

    def searched(current: Array, change: Array, velocity: Array, moving: Array) -> Array:
        """Step length along a change of the impulses."""

        def slope(share: Any) -> Array:
            reached = velocity + share * moving
            wanted = jnp.where(pulling(reached), -reached / soft, 0.0)
            return jnp.sum(moving * (current + share * change - wanted), axis=0)

        def halve(_: Any, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
            low, high = bounds
            middle = 0.5 * (low + high)
            ahead = slope(middle) > 0.0
            return jnp.where(ahead, low, middle), jnp.where(ahead, middle, high)

        low, high = lax.fori_loop(0, HALVINGS, halve, (jnp.zeros(lanes), jnp.ones(lanes)))
        return jnp.where(slope(1.0) > 0.0, 0.5 * (low + high), 1.0)

    def one(now: _Iterate) -> _Iterate:
        both = now.active[:, None] & now.active[None]
        matrix = jnp.where(both, compliance, 0.0) + eye * jnp.where(now.active, soft, 1.0)[None]
        aim = _solved(matrix, jnp.where(now.active, -free, 0.0))
        reached = free + product(aim)
        same = jnp.all(pulling(reached) == now.active, axis=0)

        def go_on() -> tuple[Array, Array, Array]:
            velocity = free + product(now.impulse)
            change, moving = aim - now.impulse, reached - velocity
            largest = jnp.maximum(jnp.max(jnp.abs(free), axis=0), jnp.max(jnp.abs(velocity), axis=0))
            still = jnp.max(jnp.abs(moving), axis=0) <= TOLERANCE * largest
            share = jnp.where(still, 1.0, searched(now.impulse, change, velocity, moving))
            # The constraint set of the step before does not match its impulses: no Newton step continues from it.
            share = jnp.where(now.iteration > 0, share, 0.0)
            return now.impulse + share * change, pulling(velocity + share * moving), still & (now.iteration > 0)

        done = now.found | same
        impulse, active, still = lax.cond(jnp.all(done), lambda: (aim, now.active, jnp.zeros(lanes, bool)), go_on)
        impulse = jnp.where(now.found, now.impulse, jnp.where(same, aim, impulse))
        return _Iterate(impulse, jnp.where(done, now.active, active), done | still, now.iteration + 1)

    first = _Iterate(start, usable & (start > 0.0), jnp.zeros(lanes, bool), jnp.zeros((), int))
    last = lax.while_loop(lambda now: ~jnp.all(now.found) & (now.iteration < ITERATIONS), one, first)
    return last.impulse, last.found.astype(float)
