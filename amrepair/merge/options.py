"""What views are placed and judged by: shares of surface, and lengths in units of a measurement."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class MergeOptions:
    """Each figure once. "Noise" is a scan's own, "spacing" its own, "size" the part's diagonal.

    Attributes
    ----------
    least_overlap, least_overlap_guessed
        Share of one group of views that must lie on another; more where the sensors' places had to
        be guessed. Sixty-nine views of nine parts shared at least 0.11 with what they were laid on.
    most_against, most_against_guessed
        Share of a view that may contradict another: noise, edges, and small defects. At their true
        poses the same views had 0.013 at most.
    cropped_share
        What lies beside a view's silhouette does not speak against a pose as long as it is less
        than this share of the overlap: people crop what they scan (of the ten range images of the
        Stanford bunny up to 0.3 of a view lies beside another's silhouette, at the true poses).
    rival_share, rival_against
        Another pose is as good where it has this share of the overlap asked for, and at most so
        much more against it.
    reach_spacings, free_spacings
        How far surfaces that are one may lie apart, and by how much a ray must pass.
    off_spacings, off_noises
        Surface that faces one way is another's where it is farther off than chance and curves make
        it (spacings), and noise.
    same_size
        Of the size: poses that differ by less are one.
    scale_noises
        Of the joint refinement's loss: residuals beyond are not believed.
    """

    least_overlap: float = 0.1
    least_overlap_guessed: float = 0.2
    most_against: float = 0.05
    most_against_guessed: float = 0.03
    cropped_share: float = 0.67
    rival_share: float = 0.75
    rival_against: float = 0.015
    reach_spacings: float = 3.0
    free_spacings: float = 1.5
    off_spacings: float = 0.25
    off_noises: float = 6.0
    same_size: float = 0.02
    scale_noises: float = 4.0

    def overlap(self, *, guessed: bool) -> float:
        """Of one group on another, at least."""
        return self.least_overlap_guessed if guessed else self.least_overlap

    def against(self, *, guessed: bool) -> float:
        """Of a view, at most."""
        return self.most_against_guessed if guessed else self.most_against
