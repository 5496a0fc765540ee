"""The bank in plain torch: the definition, and the fallback without a compiler.

Streams are taken one by one, so that none can touch another; the members of the bank are a tensor dimension.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ..filter_streams import units_of
from ..kalman_filter import ERROR_RATE, STREAK, LocalFilter, spread_with
from ..local_functions import LocalFunctions
from ..stream_state import StreamState
from .members import QuadraticModels, Stretch, TrackerModels, learn_hyperparameters, quadratic_features
from .rules import (
    FADING,
    GROUPS,
    PLAIN,
    SEARCHED,
    TRACKERS,
    TURNED,
    TURNED_FADING,
    BankShape,
    Rules,
    answer_layout,
    constant,
    judge,
    layout,
    mix,
    parts,
)

_RESET = ("skipped", "learned")  # what a stream that begins anew keeps
JUDGED = 2  # the local process by whose unknown share x is away from the samples


Views = dict[str, Tensor]
"""The part of the table that belongs to a stream, by name."""


class BankDefinition:
    """The methods of the compiled bank on a table (S, size), in place; ``functions`` are those of the
    carried filters."""

    def __init__(self, shape: BankShape, rules: Rules, functions: LocalFunctions) -> None:
        self.shape, self.rules, self.functions = shape, rules, functions
        ratio = torch.full(
            (len(rules.carried_forgetting),), rules.carried_ratio, dtype=torch.float64, device="cpu"
        )
        forgetting = torch.tensor(rules.carried_forgetting, dtype=torch.float64, device="cpu")
        self.share = torch.tensor(rules.quadratic_forgetting, dtype=torch.float64, device="cpu")
        self.prior = torch.tensor(rules.quadratic_prior, dtype=torch.float64, device="cpu")
        self.filter = LocalFilter(functions, ratio, forgetting, rules.carried_slack)

    def each(self, table: Tensor, answers: Tensor) -> list[Views]:
        """Return the streams of a table (S, size), with their latest answers (S, size of one)."""
        own, answer = layout(self.shape), answer_layout(self.shape)
        return [parts(own, row) | parts(answer, of) for row, of in zip(table, answers, strict=True)]

    def clear(self, s: Views) -> None:
        """Begin anew."""
        for name, part in s.items():
            if name not in _RESET:
                part.zero_()
        s["last_x"].fill_(torch.nan)
        for name in ("spread", "excess", "error", "pace", "own", "best", "calibration", "quadratic_error"):
            s[name].fill_(1.0)
        s["correction_covariance"].copy_(
            self.rules.correction_prior * torch.eye(GROUPS, dtype=torch.float64, device="cpu")
        )
        for name in ("rate", "noise", "forgetting"):
            rule = getattr(self.rules, f"tracker_{name}")
            s[f"tracker_{name}"].copy_(torch.tensor(rule, dtype=torch.float64, device="cpu"))
        s["metric"].copy_(torch.eye(self.shape.dim, dtype=torch.float64, device="cpu"))
        s["order"].fill_(-1.0)
        s["gap"].fill_(torch.inf)
        s["low"].fill_(torch.inf)
        s["high"].fill_(-torch.inf)
        self._restart_linear(s)

    def _restart_linear(self, s: Views) -> None:
        s["covariance"].copy_(
            self.rules.linear_prior * torch.eye(self.shape.dim + 1, dtype=torch.float64, device="cpu")
        )
        s["linear"].zero_()
        s["filters"].zero_()
        s["filters"][: 2 * self.shape.dim].fill_(torch.nan)
        QuadraticModels(s["factor"], s["quadratic"]).restart(self.prior)
        for part in _trackers(s):
            part.zero_()

    def _units(self, s: Views) -> tuple[Tensor, Tensor]:
        if self.rules.scaling:
            return s["center"], s["spread"]
        return torch.zeros_like(s["center"]), torch.ones_like(s["spread"])

    def _filters(self, s: Views) -> StreamState:
        """The carried filters as streams of a `LocalFilter`, one a lane."""
        state = StreamState.empty(
            s["x"], len(self.rules.carried_forgetting), self.shape.dim, self.shape.dim + 1, len(s["error"])
        )
        state.put(s["filters"][:-1])
        state.counts[3].copy_(s["filters"][-1])
        return state

    def predict(self, s: Views, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation at x (n,): (K,), (K,)."""
        x = torch.where(torch.isnan(x), s["last_x"], x)
        if float(s["count"]) == 0:
            return torch.zeros_like(s["mean"]), torch.ones_like(s["mean"])
        self._ask(s, x, s["time"])
        center, spread = (part[self.shape.dim :] for part in self._units(s))
        return s["mean"] * spread + center, s["variance"].sqrt() * spread

    def _ask(self, s: Views, x: Tensor, now: Tensor) -> None:
        """Store the prediction of every member at x and a time, and their mixture."""
        r, n = self.rules, self.shape.dim
        center, spread = self._units(s)
        u = torch.cat((torch.ones(1, dtype=torch.float64, device="cpu"), (x - center[:n]) / spread[:n]))
        line = (s["linear"] * u).sum(-1)
        process = self._local_processes(s, x, now, u[1:], line)
        carried = self.filter.predict(self._filters(s), u[1:].expand(len(r.carried_forgetting), -1))
        latest = s["waiting_y" if float(s["waiting"]) == 1 else "last_y"]
        last = ((latest - center[n:]) / spread[n:])[:, None]
        common = (1 + (u * (s["covariance"] * u).sum(-1)).sum()).expand_as(last)
        features = quadratic_features(u[1:], self.shape.features)
        bent, wide_of = QuadraticModels(s["factor"], s["quadratic"]).predict(features)
        jitter = r.tracker_jitter
        rules = s["tracker_rate"], s["tracker_noise"]
        tracked, tracked_spread = _trackers(s).predict(_tracked_at(s, u[1:]), *rules, jitter)
        # where a tracker knows nothing it says what the linear model says
        unknown = (tracked_spread - s["tracker_noise"]).clamp(max=1.0)
        tracked = tracked + unknown.square() * line[:, None]
        means = torch.cat((process[0], carried[0].mT, bent, tracked, line[:, None], last), 1)
        own = (
            process[1],
            carried[1].mT.square(),
            wide_of * s["quadratic_error"],
            tracked_spread.expand_as(tracked),
        )
        variances = torch.cat((*own, common, torch.ones_like(last)), 1)
        ends = torch.minimum(s["low"], latest), torch.maximum(s["high"], latest)
        low, high = ((end - center[n:]) / spread[n:] for end in ends)
        wide = r.margin * (high - low)
        means = torch.where(torch.isfinite(means), means, last)
        means = torch.maximum(torch.minimum(means, (high + wide)[:, None]), (low - wide)[:, None])
        s["means"].copy_(means)
        s["variances"].copy_(torch.where(variances < 1e300, variances, 1e300))
        level, spread = (s["level"] - center[n:]) / spread[n:], s["wide"] / spread[n:]
        mix(r, s, low - wide, high + wide, level, spread)
        s["asked"].copy_(x)
        s["answered"].fill_(1.0)

    def _apart(self, s: Views, a: Tensor, b: Tensor) -> Tensor:
        return ((a - b) / self._units(s)[1][: self.shape.dim]).square().sum(-1)

    def _local_processes(
        self, s: Views, x: Tensor, now: Tensor, u: Tensor, line: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Means and variances of the 24 local processes of what the linear model leaves: (K, 24), (K, 24)."""
        r, n, count = self.rules, self.shape.dim, int(float(s["count"]))
        latest = s["order"][:count].argsort(descending=True)
        nearest = latest[self._apart(s, s["x"][:count][latest], x).argsort(stable=True)]
        center, spread = self._units(s)
        most = min(self.shape.neighbours, count)
        sides, rests = [], []
        when = torch.cat((s["when"][nearest[:most]], now[None]))
        ages = (when[:, None] - when[None]).abs()
        for chosen in (nearest[:most], latest[:most]):
            at = (s["x"][chosen] - center[:n]) / spread[:n]
            y = (s["y"][chosen] - center[n:]) / spread[n:]
            rests.append((y - s["linear"][:, 0] - at @ s["linear"][:, 1:].mT).mT)  # (K, k)
            points = torch.cat((at, u[None]))
            square = (points[:, None] - points[None]).square().sum(-1)
            sides.append([(-rate * square).exp() for rate in r.width_rates])
        fades = [torch.ones_like(ages), *((-rate * ages).exp() for rate in r.fade_rates)]
        kernels = [sides[0][w] * fade for fade in fades for w in (0, 0, 1, 1, 2, 2)]
        kernels += [sides[1][w] for w in (0, 0, 1, 1, 2, 2)]
        noise = torch.tensor(r.noise, dtype=torch.float64, device="cpu")
        rest = torch.stack([rests[select] for select in (0, 0, 0, 1) for _ in range(6)])  # (24, K, k)
        means, variances, unknown = _processes(torch.stack(kernels), noise, rest, line)
        s["unknown"].copy_(unknown[JUDGED])
        return means, variances

    def _carry(self, s: Views, x: Tensor, y: Tensor, lapse: float) -> None:
        """The linear model, the quadratics, the trackers and the filters learn (x, y)."""
        r, n = self.rules, self.shape.dim
        center, spread = self._units(s)
        u = torch.cat((torch.ones(1, dtype=torch.float64, device="cpu"), (x - center[:n]) / spread[:n]))
        v = (y - center[n:]) / spread[n:]
        gain = (s["covariance"] * u).sum(-1)
        total = 1 + (u * gain).sum()
        s["linear"].add_((v - (s["linear"] * u).sum(-1))[:, None] * gain / total)
        s["covariance"].sub_(gain[:, None] * gain / total)
        if float(s["covariance"].diagonal().max()) < 100 * r.linear_prior:
            s["covariance"].div_(r.linear_forgetting**lapse)
        features = quadratic_features(u[1:], self.shape.features)
        QuadraticModels(s["factor"], s["quadratic"]).learn(features, v, self.share**lapse, self.prior)
        rules = s["tracker_rate"], s["tracker_noise"], s["tracker_forgetting"] ** lapse
        _trackers(s).learn(_tracked_at(s, u[1:]), v, *rules, r.tracker_jitter, r.tracker_wrong)
        state, lanes = self._filters(s), len(r.carried_forgetting)
        lapses = torch.full((lanes,), lapse, dtype=torch.float64, device="cpu")
        self.filter.learn(state, u[1:].expand(lanes, -1), v.expand(lanes, -1), lapses)
        s["filters"][:-1].copy_(state.table)
        s["filters"][-1].copy_(state.counts[3])

    def _rescale(self, s: Views) -> None:
        """Units from the samples in the store, which has all of them; the carried models relearn."""
        count = int(float(s["count"]))
        samples = torch.cat((s["x"], s["y"]), 1)[:count]
        center, spread = units_of(samples)
        spread = torch.where(spread > 1e-150, spread, 1.0)
        s["center"].copy_(center)
        s["spread"].copy_(spread)
        never = s["low"] == torch.inf  # measured so far
        s["low"].fill_(torch.inf)
        s["high"].fill_(-torch.inf)
        if count >= self.rules.searched_at:
            self._learn_trackers(s, count)
        s["map"].zero_()
        self._restart_linear(s)
        for j in range(count):
            if self._beyond(s, s["x"][j], s["y"][j]):
                continue
            torch.minimum(s["low"], torch.where(never, torch.inf, s["y"][j]), out=s["low"])
            torch.maximum(s["high"], torch.where(never, -torch.inf, s["y"][j]), out=s["high"])
            self._carry(s, s["x"][j], s["y"][j], float(s["when"][j] - s["when"][j - 1]) if j else 1.0)

    def _learn_trackers(self, s: Views, count: int) -> None:
        """Four trackers' hyperparameters, from the latest samples in the store, which are in their order."""
        usable = [j for j in range(count) if not self._beyond(s, s["x"][j], s["y"][j])][-SEARCHED:]
        n, (center, spread) = self.shape.dim, self._units(s)
        samples = (torch.cat((s["x"], s["y"]), 1)[usable] - center) / spread
        found = learn_hyperparameters(Stretch(samples[:, :n], samples[:, n:], s["when"][usable]))
        s["metric"].copy_(found.metric)
        for lane, choice in zip((TURNED, PLAIN, FADING, TURNED_FADING), found[:-1], strict=True):
            s["tracker_rate"][lane], s["tracker_noise"][lane] = choice.rate, choice.noise
            s["tracker_forgetting"][lane] = math.exp(-2 * choice.fade)

    def _beyond(self, s: Views, x: Tensor, y: Tensor) -> bool:
        both = torch.cat((x, y))
        if not bool((both.abs() < 1e150).all()):
            return True
        # young units may be tiny: squares must be numbers
        most = self.rules.far if float(s["clock"]) >= 40 else 1e100
        near = (both - s["center"]).abs() < most * s["spread"]
        return float(s["clock"]) >= 2 and not bool(near.all())

    def _keep(self, s: Views, x: Tensor, y: Tensor, time: float) -> None:
        """Keep (x, y). A full store gives up the older of the closest pair of those that are not recent."""
        old, count = float(s["clock"]) - self.rules.recent, int(float(s["count"]))
        order, gap = s["order"], s["gap"]
        if count < self.shape.capacity:
            slot, count = count, count + 1
            s["count"].fill_(count)
        else:
            among = order <= old
            closest = among & (gap == torch.where(among, gap, torch.inf).min())
            slot = int(torch.where(closest, order, torch.inf).argmin())
            others = among.clone()
            others[slot] = False
            distance = self._apart(s, s["x"], s["x"][slot])
            for i in (others & (distance == gap)).nonzero().flatten().tolist():
                rest = others.clone()
                rest[i] = False
                gap[i] = torch.where(rest, self._apart(s, s["x"], s["x"][i]), torch.inf).min()
        s["x"][slot], s["y"][slot], s["when"][slot] = x, y, time
        order[slot], gap[slot] = s["clock"], torch.inf
        for i in (order == old + 1).nonzero().flatten().tolist():
            among = (order <= old) & (order >= 0)
            distance = torch.where(among, self._apart(s, s["x"], s["x"][i]), torch.inf)
            gap[i] = torch.minimum(gap[i], distance.min())
            torch.minimum(gap, distance, out=gap)

    def learn(self, s: Views, given: Tensor, told: Tensor, lapse: float) -> None:
        """Learn one sample: (n,), (K,)."""
        x = torch.where(torch.isnan(given), s["last_x"], given)
        repeats = torch.equal(x, s["last_x"])
        seen, known = ~torch.isnan(told), float(s["count"]) > 0
        sound = torch.isfinite(x).all() & seen.any() & ~torch.isnan(given).all() & ~torch.isinf(told).any()
        asked = float(s["answered"]) and float(s["unlearned"]) == 0 and bool((x == s["asked"]).all())
        # judged is what was to be expected right after the sample before, whether or not somebody has asked
        if known and bool(sound) and not asked:
            self._ask(s, x, s["time"] - s["unlearned"])
        for name in ("answered", *(() if known else ("mean",))):
            s[name].zero_()
        s["last_x"].copy_(torch.where(given.abs() < 1e150, given, s["last_x"]))
        for name in ("time", "unlearned"):
            s[name].add_(lapse)
        if not bool(sound):
            s["skipped"].add_(1)
            return
        center, spread = (part[self.shape.dim :] for part in self._units(s))
        # the first value of an output says nothing of predictions
        first = seen & (s["low"] == torch.inf) & (told.abs() < 1e150) & known
        judged = seen & ~first
        y = torch.where(judged, told, s["mean"] * spread + center)
        s["far"].copy_(s["far"] + 1 if self._beyond(s, x, y) else 0 * s["far"])
        if float(s["far"]) >= STREAK:  # the stream has gone elsewhere for good
            time = s["time"].clone()
            self.clear(s)
            s["last_x"].copy_(x)
            s["time"].copy_(time)
            s["far"].fill_(float(STREAK) if self._beyond(s, x, y) else 0.0)
        elif known and float(s["far"]) == 0:
            lapse = float(s["unlearned"])
            s["unlearned"].zero_()
            since = self._waits(s, x, y, judged, lapse)
            if since is None:
                return
            lapse = since
            usual, clock = s["usual_unknown"], float(s["clock"])
            usual.add_(max(ERROR_RATE, 1 / max(clock - 1, 1.0)) * (s["unknown"] - usual))
            # a sample that repeats the last one says nothing of errors
            says = judged & ~(repeats & torch.eq(y, s["last_y"]) & ~constant(s))
            judge(self.rules, s, (y - center) / spread, says, clock)
        if float(s["far"]) > 0:
            s["skipped"].add_(1)
            return
        s["unlearned"].zero_()
        # until now nothing was known of these: they count as if they had always been so
        y = torch.where(first, told, y)
        s["y"][: int(float(s["count"]))] = torch.where(first, told, s["y"][: int(float(s["count"]))])
        self._notice(s, y, seen)
        self._accept(s, x, y, float(s["time"]), lapse, anew=bool(first.any()))

    def _waits(self, s: Views, x: Tensor, y: Tensor, seen: Tensor, lapse: float) -> float | None:
        """Time since the last sample that was learned, or None where this one waits.

        A sample that nobody expected does; it is learned if the next is as far off, else skipped.
        """
        center, spread = (part[self.shape.dim :] for part in self._units(s))
        r = self.rules
        away = ((y - center) / spread - s["mean"]).abs()
        most = torch.where(away > r.outside, r.doubtful_outside, r.doubtful).to(away)
        doubtful = bool((seen & (away > most * torch.maximum(s["variance"], s["pace"]).sqrt())).any())
        waiting, rare = float(s["waiting"]) == 1, float(s["doubted"]) < r.rare
        s["waiting"].zero_()
        s["doubted"].add_(r.doubted_rate * (float(doubtful) - s["doubted"]))
        if doubtful and rare and float(s["clock"]) >= r.settled and float(s["trust"]) == 0:
            if not waiting:
                for name, value in (("x", x), ("y", y), ("time", s["time"])):
                    s[f"waiting_{name}"].copy_(value)
                s["waiting_lapse"].fill_(lapse)
                s["waiting"].fill_(1.0)
                return None
            s["trust"].fill_(float(STREAK))
            self._notice(s, s["waiting_y"], torch.zeros_like(seen))
            when = float(s["waiting_time"]), float(s["waiting_lapse"])
            self._accept(s, s["waiting_x"].clone(), s["waiting_y"].clone(), *when)
            return lapse
        s["trust"].sub_(1.0).clamp_(min=0.0)
        if not waiting:
            return lapse
        s["skipped"].add_(1)
        return float(s["waiting_lapse"]) + lapse

    def _notice(self, s: Views, y: Tensor, measured: Tensor) -> None:
        """The range, running mean and spread of y, of outputs that are measured now or have been before."""
        known = measured | (s["low"] < torch.inf)
        torch.minimum(s["low"], torch.where(known, y, torch.inf), out=s["low"])
        torch.maximum(s["high"], torch.where(known, y, -torch.inf), out=s["high"])
        s["last_y"].copy_(torch.where(known, y, s["last_y"]))
        spread, running = torch.where(constant(s), 1.0, s["wide"]), ("level", "wide", "leaps", "told")
        found = spread_with(y, s["level"], s["wide"], spread, s["leaps"], s["told"], s["clock"])
        for name, new in zip(running, found, strict=True):
            s[name].copy_(torch.where(known, new, s[name]))

    def _accept(self, s: Views, x: Tensor, y: Tensor, time: float, lapse: float, anew: bool = False) -> None:
        s["clock"].add_(1)
        s["learned"].add_(1)
        self._keep(s, x, y, time)
        anew = anew or float(s["clock"]) in self.rules.learned_at
        if anew and float(s["clock"]) <= self.shape.capacity:
            self._rescale(s)
        else:
            self._carry(s, x, y, lapse)


def _tracked_at(s: Views, u: Tensor) -> Tensor:
    """Return u (n,) as the trackers see it, some of them in the coordinates of the metric: (n, L)."""
    found = u[:, None].repeat(1, TRACKERS)
    found[:, [TURNED, TURNED_FADING]] = (s["metric"].mT @ u)[:, None]
    return found


def _trackers(s: Views) -> TrackerModels:
    parts = ("tracked", "tracker_weights", "tracker_known", "tracker_inverse", "tracker_counts")
    return TrackerModels(*(s[name] for name in parts))


def _processes(kernels: Tensor, noise: Tensor, rest: Tensor, line: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return Gaussian processes at the last of k + 1 points from the others, by elimination: kernels
    (members, k + 1, k + 1), noise in units of the amplitudes (members,), values ``rest`` (members, K, k),
    ``line`` (K,) added to the means."""
    a, count = kernels.clone(), kernels.shape[-1] - 1
    a[:, :count, :count] += noise[:, None, None] * torch.eye(count, dtype=a.dtype, device=a.device)
    seen, mean = torch.zeros_like(noise), torch.zeros_like(rest[..., 0])
    amplitude, right = torch.zeros_like(mean), rest.clone()
    for k in range(count):
        root = torch.maximum(a[:, k, k], noise).sqrt()  # a Schur complement is no smaller than the noise
        column = a[:, k + 1 :, k] / root[:, None]
        beta = right[..., k] / root[:, None]
        mean, amplitude = mean + beta * column[:, -1:], amplitude + beta.square()
        seen = seen + column[:, -1].square()
        right[..., k + 1 :] -= beta[..., None] * column[:, None, :-1]
        a[:, k + 1 :, k + 1 :] -= column[:, :, None] * column[:, None]
    amplitude = amplitude / count
    variance = torch.maximum(amplitude * (1 + noise - seen)[:, None], amplitude * noise[:, None])
    return (line + mean).mT, variance.mT, (1 - seen).clamp(min=0.0)
