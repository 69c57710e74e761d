"""Settings measured on probe sequences, each once: what is measured is kept on disk."""

from __future__ import annotations

import contextlib
import hashlib
import json
import sys
from pathlib import Path

import numpy as np

from synth.dataset import provenance
from synth.errors import UserError
from synth.job.schema import Job
from synth.tune.parameters import Settings, changed, list_parameters, show
from synth.tune.probe import Measured, Probe

_DRAWS = 5
_FAILED = Measured(np.full((1, 1), np.inf), np.full((1, 1), np.inf), np.full(4, np.inf))


class Measurements:
    """Measures settings of a job on sequences like its own, none of which is one of them."""

    def __init__(self, job: Job, journal: Path) -> None:
        """Takes up what is in the file `journal` of this job and this code, and appends to it."""
        self.job = job
        self.parameters = list_parameters(job)
        self.full_fidelity: Settings = {one.key: one.settings[0] for one in self.parameters}
        self.expected = 0
        """About how many measurements there will be, for the progress on stderr."""
        job_hash = hashlib.blake2b(job.model_dump_json().encode(), digest_size=8).hexdigest()
        self._made_by = f"{job_hash} {provenance.fingerprint()}"
        self._journal = journal
        self._probes: dict[int, tuple[Job, Probe]] = {}
        self._known: dict[str, Measured] = {}
        for line in journal.read_text("utf-8").splitlines() if journal.exists() else []:
            with contextlib.suppress(ValueError, TypeError):  # cut off, or of an older version
                key, found = json.loads(line)
                self._known[key] = Measured(*map(np.array, found))

    def measure(self, sequence: int, settings: Settings) -> Measured:
        """A sequence with some settings, all others at full fidelity; infinite if they cannot carry it out.

        Raises:
            UserError: it cannot be carried out even at full fidelity.
        """
        settings = {**self.full_fidelity, **settings}
        key = f"{self._made_by} {sequence} {sorted(settings.items())}"
        if key not in self._known:
            job, probe = self._probe(sequence)
            found = _FAILED
            with contextlib.suppress(UserError):
                found = probe.measure(changed(job, settings))
            self._known[key] = found
            with self._journal.open("a", encoding="utf-8") as file:
                # The newline comes first, so that a line that was cut off before spoils itself alone.
                values = found.label.tolist(), found.read.tolist(), found.cost.tolist()
                file.write("\n" + json.dumps([key, values]))
            changes = sorted(settings.items() - self.full_fidelity.items())
            words = ", ".join(f"{name} {show(one)}" for name, one in changes) or "full fidelity"
            done = f"{len(self._known)} of about {max(len(self._known), self.expected)}"
            print(f"[{done}] sequence {sequence}: {words}", file=sys.stderr, flush=True)
        return self._known[key]

    def predict(self, sequence: int, settings: Settings) -> Measured:
        """The same to first order, from what each parameter does by itself."""
        found = self.measure(sequence, {})
        label, read, cost = np.zeros_like(found.label), found.read, found.cost
        for one in self.parameters:
            base = self.measure(sequence, one.base)
            found = self.measure(sequence, {**one.base, one.key: settings[one.key]})
            label, read = label + found.label - base.label, read + found.read - base.read
            cost = cost * np.divide(found.cost, base.cost, out=np.ones(4), where=base.cost > 0)
        return Measured(label, read, cost)

    def _probe(self, sequence: int) -> tuple[Job, Probe]:
        """A sequence's job and probe; draws that cannot be carried out at full fidelity are passed over."""
        for attempt in range(_DRAWS):
            if sequence in self._probes:
                break
            words = f"tune {self.job.seed} {sequence} {attempt}".encode()
            seed = int.from_bytes(hashlib.blake2b(words, digest_size=7).digest(), "big")
            gestures, families = self.job.fem.gestures, self.job.appearance.families
            own = {
                "seed": seed,
                "sequences": 1,
                "fem.gestures": [gestures[sequence % len(gestures)]],  # in turn
                "appearance.families": [families[sequence % len(families)]],
            }
            job = changed(self.job, {**own, **self.full_fidelity})
            try:
                self._probes[sequence] = job, Probe(job)
            except UserError:
                if attempt == _DRAWS - 1:
                    raise
        return self._probes[sequence]
