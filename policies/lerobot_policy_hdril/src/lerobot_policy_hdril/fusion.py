"""Predictions in the frame of the world and of every object, fused by their joint precision.

A movement is often simple in the frame of the object that it is about: a grasp ends at the same place of the object, wherever
that is. Which object counts, and when, is learned: the frame in which demonstrations agree predicts with little variance, and
weighs most. Source of the idea: task-parameterised Gaussian mixtures (Calinon, A tutorial on task-parameterized movement
learning and retrieval, 2016). Here the Gaussian of each frame comes from a linear map of what is seen.

From a frame, little matters: where the hands are, as seen from there, and what is carried. A few demonstrations cannot tell
that from some hundred numbers. So the maps are told: the ridge penalty of a frame's map is light on what is seen from that
frame, and heavy on all else.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lerobot_policy_hdril.coordinates import Origins, apply, positive, product, towards, unit
from lerobot_policy_hdril.dynamics import FREE, solve_ridge, usual_windows
from lerobot_policy_hdril.fourier import FourierFeatures
from lerobot_policy_hdril.graph import node_of, pose_groups

_FLOOR = 1e-7
"""Least variance, m² and of a quaternion's numbers: no frame is trusted further than a third of a millimetre."""
RIDGES = ((1.0, 30.0), (0.1, 10.0), (0.01, 3.0))
"""Penalties on what a frame sees, and on what stands still there, the heaviest first. Each frame's map has the heaviest whose
leave-one-out error is not clearly above the least: a light one may follow noise, and a heavy one may draw a hand off the place
that it goes to."""
CLEARLY = 2.0
"""Times that a mean squared leave-one-out error must be above the least one for a penalty to be too heavy."""
BENDS = 1.03
"""A map bends with where its frame's object stands (:class:`~lerobot_policy_hdril.fourier.FourierFeatures`) unless its mean
squared leave-one-out error is then more than so many times as large, as it is where there are few demonstrations. To ask for a
smaller one would be too much: where a hand goes in the next frames hangs on where it is, and little on where it will end."""
SHUT_OUT = 1e9
"""Penalty on features that a map is not to see at all."""
MOVED = 0.03
"""Distance from its longest mean, m, at which an object counts as just moved, in the median of the demonstrations. It goes with a
mean of 24 frames at 10 frames a second; without a mean, nothing counts as moved."""
SUPPORT = 0.5
"""Share of a primitive's executions that must reach a start for it to have a map to itself, and of a start's windows that must
reach a step."""
HAND, NO_POSE = -1, -2  # owners of numbers that are no object's with a pose


class ObjectFrames(nn.Module):
    """Poses of a state as they are seen from the world and from every object with a pose.

    Beside the state there are means of the last ones: views, and the state is view 0. An object gives a frame in each view, where
    it stands in that. What is seen from there is what the view shows, and the hands as they are now.

    With ``fourier``, the map in a frame may bend with where its object stands, as the last view shows it
    (:class:`~lerobot_policy_hdril.fourier.FourierFeatures`).

    Args:
        state_names: names of the state's numbers, hands and objects.
        objects: which of them are objects'.
        action_names: names of an action's numbers.
        views: the state, and how many means are beside it.
        fourier: random Fourier features of each object; 0 for none.

    Raises:
        ValueError: no object has a pose, or the actions have none.
    """

    def __init__(
        self, state_names: list[str], objects: list[str], action_names: list[str], views: int = 1, fourier: int = 0
    ) -> None:
        super().__init__()
        poses, hands = pose_groups(state_names), pose_groups(action_names)
        frames = [group for group in poses if state_names[group[0]] in objects]
        if not frames or not hands:
            raise ValueError(
                "policy.coordinates=fused needs poses of objects and poses in the actions; "
                f"objects: {', '.join(objects)}; actions: {', '.join(action_names)}. policy.preset=hdril needs none"
            )
        rest = [i for i in range(len(action_names)) if not any(i in hand for hand in hands)]
        columns = {"objects": frames, "hands": hands, "rest": rest}
        for name, value in columns.items():
            self.register_buffer(name, torch.tensor(value, dtype=torch.long), persistent=False)
        self.register_buffer("world", torch.eye(7)[6], persistent=False)
        self.views, self.count, self._others = views, 1 + views * len(frames), len(poses) - 1
        self._list_columns(state_names, poses, frames)
        posed = {column for group in poses for column in group}
        numbers = [column for column, name in enumerate(state_names) if name in objects and column not in posed]
        self.fourier = FourierFeatures(self.objects, numbers, fourier) if fourier else None
        self.width = self.dim + (len(self.fourier.owner) if self.fourier else 0)

    objects: Tensor  # (F, 7), columns of a state: the poses of objects
    hands: Tensor  # (G, 7), columns of an action
    rest: Tensor  # columns of an action that are no pose's
    world: Tensor  # (7,), its pose
    looked_at: Tensor  # (V F, P - 1 + H, 7), columns of V states side by side: what is seen from each object's frame
    kept: Tensor  # which of these numbers are features; hands in view 0 stand there twice
    alike: Tensor  # (D,), the feature of a single view that is the same, but for the view
    # Of every feature, (D,):
    seen_from: Tensor  # the frame
    view: Tensor  # of which state it is
    owner: Tensor  # the object, HAND or NO_POSE
    of_pose: Tensor  # whether it is of a pose

    def _list_columns(self, names: list[str], poses: list[list[int]], frames: list[list[int]]) -> None:
        """What each feature is."""
        size, still = len(names), [group for group in poses if group not in frames]
        owners = dict.fromkeys(map(node_of, names), NO_POSE)
        owners |= {node_of(names[group[0]]): HAND for group in still}
        owners |= {node_of(names[group[0]]): frame for frame, group in reversed(list(enumerate(frames)))}
        posed = {column for group in poses for column in group}
        looked_at, kept, features = [], [], []  # a feature: (alike, seen_from, view, owner, of_pose)
        for view in range(self.views):
            for column, name in enumerate(names):
                features.append((column, 0, view, owners[node_of(name)], column in posed))
        number = 0
        for view in range(self.views):
            for frame, own in enumerate(frames):
                others = [group for group in poses if group != own]
                seen = [(group, view) for group in others] + [(group, 0) for group in still]
                looked_at.append([[column + size * of for column in group] for group, of in seen])
                for place, (group, of) in enumerate(seen):
                    owner = frames.index(group) if group in frames else HAND
                    first = size + 7 * (frame * len(others) + others.index(group))
                    if view or place < len(others):
                        kept += range(number, number + 7)
                        about = (1 + view * len(frames) + frame, of, owner, True)
                        features += [(first + axis, *about) for axis in range(7)]
                    number += 7
        alike, seen_from, of_view, owner, of_pose = zip(*features, strict=True)
        columns = {"alike": alike, "seen_from": seen_from, "view": of_view, "owner": owner, "kept": kept}
        for name, value in columns.items():
            self.register_buffer(name, torch.tensor(value, dtype=torch.long), persistent=False)
        self.register_buffer("of_pose", torch.tensor(of_pose), persistent=False)
        shape = (self.views * len(frames), -1, 7)
        self.register_buffer("looked_at", torch.tensor(looked_at, dtype=torch.long).reshape(shape), persistent=False)
        self.dim = len(features)

    def origins(self, seen: Tensor) -> Origins:
        """The frames (1 + V F, B) of the world and of the objects in states and their means (B, V, S)."""
        poses = seen[:, :, self.objects].permute(1, 2, 0, 3).flatten(0, 1)  # (V F, B, 7)
        poses = torch.cat([self.world.to(seen).expand(1, len(seen), 7), poses])
        return Origins.at(poses[..., :3], unit(poses[..., 3:]))

    def features(self, seen: Tensor, origins: Origins | None = None) -> Tensor:
        """States and their means (B, V, S), and beside them (B, D - V S) what is seen from every object's frame; w >= 0.
        ``origins`` are those of ``seen``, if they are known."""
        origins = self.origins(seen) if origins is None else origins
        given = seen.flatten(1)
        return torch.cat([given, self._look(given, origins, self.looked_at)[:, self.kept]], dim=-1)

    def single(self, state: Tensor) -> Tensor:
        """The features that there are of states (B, S) alone."""
        poses = self.looked_at[: len(self.objects), : self._others]
        return torch.cat([state, self._look(state, self.origins(state[:, None]), poses)], dim=-1)

    @staticmethod
    def _look(given: Tensor, origins: Origins, columns: Tensor) -> Tensor:
        """Poses in those columns (F, Q, 7) of ``given`` (B, C) as seen from each of the frames but the world's (B, F Q 7)."""
        poses = positive(origins[1:].see(given[:, columns].transpose(0, 1)))  # (F, B, Q, 7)
        return poses.transpose(0, 1).flatten(1)

    def targets(self, action: Tensor, seen: Tensor) -> Tensor:
        """Hands of actions (B, M, A) from every frame of states and their means (B, V, S): (1 + V F, B, M, G, 7)."""
        return self.origins(seen)[:, :, None].see(action[..., self.hands])

    def moved(self, seen: Tensor) -> Tensor:
        """Which objects (F,) were carried or pushed just before these states (N, V, S): in the median, they are :data:`MOVED` or
        more from the longest mean."""
        places = seen[:, :, self.objects[:, :3]]  # (N, V, F, 3)
        return (places[:, 0] - places[:, -1]).norm(dim=-1).median(0).values >= MOVED

    def penalties(self, moved: Tensor, seen: float, still: float, other: float, bend: bool = False) -> Tensor:
        """The penalty of each frame's map on each feature (1 + V F, W), the Fourier features last: one of the three, or
        :data:`SHUT_OUT`.

        ``seen`` for the hands as they are now and what has moved, as they are seen from the frame; for the means of the hands
        too, if something has moved, because they tell how it is held; and for what is no pose in the present state, such as an
        opening or a size, of the hands, of what has moved, of the frame's own object and of what has no pose at all. ``still``
        for what stands still, as seen from the frame, and for where the hands are in the world. ``other`` for all else. A map
        that bends sees the Fourier features of the frame's own object for ``still``, unless that has moved; all other Fourier
        features are shut out.

        Args:
            moved: which objects have (F,).
            seen, still, other: the penalties.
            bend: whether the maps bend.
        """
        frames = torch.arange(self.count, device=moved.device)[:, None]
        objects, views = (frames - 1) % len(self.objects), (frames - 1).div(len(self.objects), rounding_mode="floor")
        objects, views = objects.where(frames > 0, NO_POSE - 1), views.clamp_min(0)  # the world's are nobody's
        hand, thing, now = self.owner == HAND, self.owner >= 0, self.view == 0
        goes = thing & moved[self.owner.clamp_min(0)]
        from_here = (self.seen_from == frames) & self.of_pose & (self.view == views)
        hands_now = (self.seen_from == frames) & self.of_pose & hand & now
        no_pose = ~self.of_pose & now & (~thing | goes | (self.owner == objects))
        light = hands_now | no_pose | (from_here & (goes | (hand & moved.any())))
        middle = (from_here & thing) | ((self.seen_from == 0) & self.of_pose & hand & now)
        penalty = torch.full(light.shape, other, dtype=torch.float64, device=moved.device)
        penalty = penalty.masked_fill(middle, still).masked_fill(light, seen)
        if self.fourier is None:
            return penalty
        bends = (self.fourier.owner == objects) & ~moved[self.fourier.owner]
        return torch.cat([penalty, torch.where(bends & bend, still, SHUT_OUT).to(penalty)], dim=-1)


class FusedMaps(nn.Module):
    """Linear maps from what is seen to the next actions, in every frame, and their fusion.

    In frame f a map predicts a hand's pose y_f; the demonstrations' leave-one-out errors of it have the covariance S_f, to which
    noise of what is seen adds. Frames err together: what the same object shows in three views differs little, and maps that
    follow the hand follow it in every frame. Were they taken as independent, many that say the same would outvote the one that
    knows. So C_fg, the correlation of their errors, is learned as well. With the frame's origin t_f and rotation R_f in the
    world, the position is that of least variance,

        x = (sum_f P_f)^-1 sum_f P_f (R_f y_f + t_f)        P_f = sum_g T_g (C^-1)_gf T_f        T_f = R_f S_f^-1/2 R_f^T

    One C serves all three axes. A frame that errs more than another does, and with it, can have a weight below 0. The orientation
    is the mean of the frames' quaternions, weighted by the inverse of their variances, as if they erred apart. What is no pose,
    such as the opening of a hand, has a map of its own, with the penalties of the world's.

    Args:
        frames: the frames, and what of an action is a pose.
        starts: frames of a primitive at which plans are made.
        ahead: frames that a plan predicts.
    """

    def __init__(self, frames: ObjectFrames, starts: int, ahead: int) -> None:
        super().__init__()
        count, hands, grid, numbers = frames.count, len(frames.hands), (starts, ahead), frames.width + 1
        self.register_buffer("weight", torch.zeros(count, *grid, 7 * hands, numbers))
        self.register_buffer("plain", torch.zeros(*grid, len(frames.rest), numbers))
        self.register_buffer("whitening", torch.eye(3).expand(count, *grid, hands, 3, 3).clone())
        self.register_buffer("agreement", torch.eye(count).expand(*grid, hands, count, count).clone())
        self.register_buffer("variance", torch.ones(count, *grid, hands))

    weight: Tensor
    plain: Tensor
    whitening: Tensor  # S_f^-1/2
    agreement: Tensor  # C^-1
    variance: Tensor

    @torch.no_grad()
    def fit(
        self,
        features: Tensor,
        start: Tensor,
        frames: ObjectFrames,
        seen: Tensor,
        action: Tensor,
        mask: Tensor,
        ridges: Sequence[tuple[float, float, float]],
        robust: bool,
        noise: Tensor,
        shrinkage: float,
    ) -> None:
        """Solve the maps, in float64, see :func:`~lerobot_policy_hdril.dynamics.solve_ridge`.

        Starts that less than half of the executions reach share the maps of the last one that enough reach, which are fitted to
        the windows of all of them: few windows cannot fit so many numbers. So do steps that less than half of a start's windows
        reach: they are as the step before. Where an execution has several windows there, the leave-one-out errors are too small,
        because its other windows stay.

        Args:
            features: what the maps see (N, W): normalised features, and the Fourier features.
            start: which of the starts a window has (N,).
            frames: the frames of the states.
            seen: states at which windows start, and their means (N, V, S).
            action: (N, M, A).
            mask: (N, M), True where there is an action: the first frames of a row, as many as it has.
            ridges: penalties on what a frame sees, on what stands still there, and on all else. For each frame, and for the
                steps that are solved together, the first ones count whose mean squared leave-one-out error of the hands'
                positions, noise included, is at most :data:`CLEARLY` times the least. What is no pose has the world's. The
                robust fit takes the first. With these penalties, maps bend where :data:`BENDS` lets them.
            robust: leave out windows whose first action is far off a first fit in the world's frame.
            noise: covariance (W, W) of noise on the features that the maps are to bear; 0 for none. The penalty grows as if every
                window were seen with such noise, and the covariance of a frame's errors by what the noise adds to them.
            shrinkage: how far correlations of the frames' errors are shrunk towards 0: with 1, frames count as independent.
        """
        for buffer, value in ((self.weight, 0.0), (self.plain, 0.0), (self.variance, 1.0)):
            buffer.fill_(value)
        self.whitening.copy_(torch.eye(3).expand_as(self.whitening))
        self.agreement.copy_(torch.eye(frames.count).expand_as(self.agreement))
        if not len(features):
            return
        inputs = torch.cat([features, torch.ones_like(features[:, :1])], dim=-1).double()
        poses, rest = frames.targets(action, seen).double(), action[..., frames.rest].double()
        rotation = frames.origins(seen).rotation.double()  # (1 + V F, N, 3, 3)
        noise = F.pad(noise.double(), (0, 1, 0, 1))
        reached = start.bincount(minlength=self.plain.shape[0])
        last = int((reached >= SUPPORT * reached[0]).nonzero().max())
        start = start.clamp_max(last)
        for first in range(last + 1):
            rows = (start == first) & mask[:, 0]
            moved = frames.moved(seen[rows])
            least = torch.stack(
                [torch.stack([frames.penalties(moved, *ridge, bend) for ridge in ridges]) for bend in (False, True)]
            )
            least = F.pad(least, (0, 1), value=FREE)
            if robust:
                world = torch.cat([_same_signs(poses[:1, rows, 0])[0].flatten(1), rest[rows, 0]], dim=-1)
                penalty = least[0, 0, 0].diag() + rows.sum() * noise
                rows = rows.masked_scatter(rows, usual_windows(inputs[rows], world, penalty))
            counts = (mask & rows[:, None]).sum(0)
            shown, begin = counts[counts >= SUPPORT * counts[0]].tolist(), 0
            for _, steps in groupby(shown):  # steps that the same rows have are solved together
                end = begin + len(list(steps))
                here = rows & mask[:, begin]
                targets = poses[:, here, begin:end], rest[here, begin:end]
                self._fit_steps(first, begin, inputs[here], *targets, rotation[:, here], least, noise, shrinkage)
                begin = end
            for by_start in self._by_start():
                by_start[first, begin:] = by_start[first, begin - 1]
        for by_start in self._by_start():
            by_start[last + 1 :] = by_start[last]

    def _by_start(self) -> list[Tensor]:
        """All buffers, their starts and steps first."""
        by_frame = [each.movedim(0, 2) for each in (self.weight, self.whitening, self.variance)]
        return [*by_frame, self.plain, self.agreement]

    def _fit_steps(
        self,
        first: int,
        begin: int,
        x: Tensor,
        poses: Tensor,
        rest: Tensor,
        rotation: Tensor,
        least: Tensor,
        noise: Tensor,
        shrinkage: float,
    ) -> None:
        """Of the start ``first``, the steps from ``begin`` on: poses (1 + V F, N, m, G, 7) and the rest of the actions
        (N, m, A - 7 G) from x (N, W + 1), with the frames' rotations (1 + V F, N, 3, 3) and penalties to choose from for each
        frame, straight and bent (2, C, 1 + V F, W + 1)."""
        poses = _same_signs(poses)
        count, rows, steps, hands = poses.shape[:4]
        outputs = torch.cat([poses.flatten(3), rest.expand(count, *rest.shape)], dim=-1)  # (1 + V F, N, m, A)

        def solve(penalty: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
            """Of penalties (1 + V F, W + 1): the maps, the hands' errors, their second moments, and the mean squared ones."""
            solution, errors = solve_ridge(x, outputs.flatten(2), penalty.diag_embed() + rows * noise)
            solution, errors = solution.unflatten(1, (steps, -1)), errors.unflatten(2, (steps, -1))
            far = errors[..., : 7 * hands].unflatten(-1, (hands, 7))  # (1 + V F, N, m, G, 7)
            weight = solution[:, :, : 7 * hands].unflatten(2, (hands, 7))
            second = torch.einsum("fnmgi,fnmgj->fmgij", far, far) / rows
            second += torch.einsum("fmgid,fmgjd->fmgij", weight @ noise, weight)
            return solution, far, second, second[..., :3, :3].diagonal(dim1=-2, dim2=-1).sum((-3, -2, -1))

        # One after the other: of thousands of windows, all together would take gigabytes.
        straight, bent = least
        solved = [torch.stack(each) for each in zip(*map(solve, straight), strict=True)]
        near = solved[3] <= CLEARLY * solved[3].min(0).values
        best, every = near.int().argmax(0), torch.arange(count, device=near.device)  # the first of them
        chosen = [each[best, every] for each in solved]
        if (straight != bent).any():
            other = solve(bent[best, every])
            better = other[3] < BENDS * chosen[3]
            chosen = [
                torch.where(better.view(-1, *[1] * (old.dim() - 1)), new, old)
                for new, old in zip(other, chosen, strict=True)
            ]
        solution, far, second, _ = chosen
        weight = solution[:, :, : 7 * hands].unflatten(2, (hands, 7))
        here = slice(begin, begin + steps)
        self.plain[first, here] = solution[0, :, 7 * hands :].to(self.plain)
        self.weight[:, first, here] = solution[:, :, : 7 * hands].to(self.weight)
        position, turn = second[..., :3, :3], second[..., 3:, 3:].diagonal(dim1=-2, dim2=-1).sum(-1)
        whitening = _inverse_root(position + _FLOOR * torch.eye(3).to(second))
        correlation = _correlation(far[..., :3], weight[..., :3, :], whitening, rotation, noise)
        agreement = torch.linalg.inv(torch.eye(count).to(second).lerp(correlation, 1.0 - shrinkage))
        self.whitening[:, first, here] = whitening.to(self.whitening)
        self.agreement[first, here] = agreement.to(self.agreement)
        self.variance[:, first, here] = (turn + _FLOOR).to(self.variance)

    def forward(self, features: Tensor, start: Tensor, frames: ObjectFrames, origins: Origins) -> Tensor:
        """Features (B, W) at starts (B,) of plans, and the frames' origins there (1 + V F, B), to actions (B, M, A) in the
        world."""
        inputs = F.pad(features, (0, 1), value=1.0)[:, None, None]
        told = (self.weight.index_select(1, start) * inputs).sum(-1).unflatten(-1, (-1, 7))  # (1 + V F, B, M, G, 7)
        poses = origins[:, :, None].place(told)
        means, axes = poses[..., :3], origins.rotation[:, :, None, None]
        whitened = product(
            axes, product(self.whitening.index_select(1, start), axes.mT)
        )  # T_f, (1 + V F, B, M, G, 3, 3)
        agreement = self.agreement.index_select(0, start).movedim((-2, -1), (0, 1))[..., None, None]
        precision = product((agreement * whitened[:, None]).sum(0), whitened)
        # Of the differences from the world's mean, which are small: precisions may differ by five orders of magnitude.
        far = apply(precision, means - means[:1]).sum(0)
        position = means[0] + torch.linalg.solve(precision.sum(0), far[..., None])[..., 0]
        rotations = unit(poses[..., 3:])
        quaternion = (towards(rotations, rotations[:1]) / self.variance.index_select(1, start)[..., None]).sum(0)
        rest = (self.plain.index_select(0, start) * inputs).sum(-1)
        action = rest.new_empty(*rest.shape[:2], len(frames.rest) + frames.hands.numel())
        action[..., frames.rest] = rest
        action[..., frames.hands] = torch.cat([position, unit(quaternion)], dim=-1)
        return action


def _inverse_root(covariance: Tensor) -> Tensor:
    """S^-1/2 of covariances S (..., 3, 3)."""
    variances, axes = torch.linalg.eigh(covariance)
    return axes * variances.rsqrt()[..., None, :] @ axes.mT


def _correlation(far: Tensor, weight: Tensor, whitening: Tensor, rotation: Tensor, noise: Tensor) -> Tensor:
    """C (m, G, 1 + V F, 1 + V F): how errors of frames correlate, in the world and over all axes, once they are whitened.

    The least variance of a frame counts as an error that no other has.

    Args:
        far: leave-one-out errors of positions in each frame (1 + V F, N, m, G, 3).
        weight: of the maps (1 + V F, m, G, 3, W + 1).
        whitening: (1 + V F, m, G, 3, 3).
        rotation: of the frames (1 + V F, N, 3, 3).
        noise: covariance of what is seen (W + 1, W + 1).
    """
    apart = torch.einsum("fnij,fmgjk,fnmgk->fnmgi", rotation, whitening, far)
    correlation = torch.einsum("fnmgi,hnmgi->mgfh", apart, apart) / far.shape[1]
    # Noise that all see moves them together, each along its own axes. It is a mean over the windows, and so are the turns between
    # frames. Where frames turn much against each other, this says less than the truth.
    between = torch.einsum("fnki,hnkj->fhij", rotation, rotation) / far.shape[1]
    moved = whitening @ weight
    correlation += torch.einsum("fmgia,ab,hmgjb,fhij->mgfh", moved, noise, moved, between)
    same = torch.eye(len(far), dtype=torch.bool, device=far.device)
    return (correlation / far.shape[-1]).masked_fill(same, 1.0)


def _same_signs(poses: Tensor) -> Tensor:
    """Poses (F, N, ..., 7) whose quaternions have the sign that is nearer to those of the other windows."""
    quaternion = towards(poses[..., 3:], poses[:, :1, ..., 3:])  # so that they have a mean
    return torch.cat([poses[..., :3], towards(quaternion, quaternion.mean(1, keepdim=True))], dim=-1)
