"""Every run that a set of comparisons needs, and their tables when they are done."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Mapping

from aim_slam_ros.ablation.runs import Images, Run, RunFolder
from aim_slam_ros.ablation.tables import Row, table
from aim_slam_ros.ablation.variants import Comparison, Variant
from aim_slam_ros.config import Config, ConfigError


@dataclass(frozen=True)
class Plan:
    """settings: of all variants, whose own settings win. images: by the sequence's label.

    seeds: how many, from 0 on. Raises ConfigError, naming the variant, where a setting is wrong.
    """

    comparisons: tuple[Comparison, ...]
    settings: Mapping[str, str]
    images: Mapping[str, Images]
    seeds: int

    def __post_init__(self) -> None:
        for comparison in self.comparisons:
            for variant in comparison.variants:
                self._config(variant, 0)

    def runs(self) -> list[Run]:
        """Each once, though several variants may need it; the first seed of all comes first."""
        every = {run.key: run for seed in range(self.seeds) for comparison in self.comparisons
                 for variant in comparison.variants for label in self.images
                 if (run := self._run(variant, label, seed))}
        return list(every.values())

    def described(self, run: Run) -> str:
        """Which variant, sequence and seed it is (the first that needs it), for a person."""
        return next(f'{label}, {variant.name}, seed {run.config.seed}'
                    for comparison in self.comparisons for variant in comparison.variants
                    for label in self.images
                    if self._run(variant, label, run.config.seed) == run)

    def tables(self, folder: RunFolder, also: tuple[str, ...] = ()) -> str:
        """Markdown, a table for each comparison; also: names of further figures."""
        spread = f'Mean ± standard deviation over {self.seeds} seeds.' if self.seeds > 1 else \
            'One seed.'
        tables = [table(comparison.title, [self._row(variant, folder)
                                           for variant in comparison.variants], also)
                  for comparison in self.comparisons]
        return '\n\n'.join([spread, *tables]) + '\n'

    def _row(self, variant: Variant, folder: RunFolder) -> Row:
        return Row(variant.name, {
            label: [folder.figures(self._run(variant, label, seed)) for seed in range(self.seeds)]
            for label in self.images})

    def _run(self, variant: Variant, label: str, seed: int) -> Run:
        return Run(self.images[label], self._config(variant, seed), variant.method)

    def _config(self, variant: Variant, seed: int) -> Config:
        try:
            return Config().with_values({**self.settings, **variant.settings, 'seed': str(seed)})
        except ConfigError as error:
            raise ConfigError(f'variant {variant.name!r}: {error}') from error
