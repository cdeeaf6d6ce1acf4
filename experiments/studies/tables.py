"""The paper's studies as data: what is trained, at which scale, and what the paper says came out of it.

An arm is a variant of the model, by flags of muvo_jax.train; `{after}` in a flag stands for the run of the arm that it
comes after, of the same seed. The paper's question is asked of models without memory, whose latent has to carry
everything; `MEMORY` is what the best and the worst arm get beside their flags when they are asked again.
"""

from __future__ import annotations

import dataclasses
import itertools

SCALES = ("smoke", "town", "paper")
PSNR, CHAMFER, IOU = "psnr_db", "chamfer_m", "iou_occ_observed"
IOU_EMPTY, PRECISION, RECALL = "iou_empty_observed", "precision_observed", "recall_observed"
LOWER_IS_BETTER = frozenset({CHAMFER})
# Differences below these are called none: an eye does not see them, and two seeds of one arm differ by as much.
MARGINS = {PSNR: 0.2, CHAMFER: 0.03, IOU: 0.02, IOU_EMPTY: 0.005, PRECISION: 0.02, RECALL: 0.02}
# Where none of the arms that a claim compares has learned more than the mean training frame, it is not told.
OF_WHAT_IS_LEARNED = {PSNR: PSNR, CHAMFER: CHAMFER, IOU: IOU, IOU_EMPTY: IOU, PRECISION: IOU, RECALL: IOU}
NAMES = {PSNR: "PSNR (dB)", CHAMFER: "Chamfer (m)", IOU: "IoU+", IOU_EMPTY: "IoU-", PRECISION: "precision",
         RECALL: "recall"}
SPLITS = ("val_rl", "val_ds")
SEEDS = {"smoke": 1, "town": 2, "paper": 1}
MEMORY = "--set model.first_guess=last_seen"


@dataclasses.dataclass(frozen=True)
class Arm:
    """One variant.

    Attributes:
      after: an arm that must be trained first.
      smoke: whether the smoke scale trains it.
      note: what a reader of the table has to know.
    """

    name: str
    flags: tuple[str, ...]
    after: str = ""
    smoke: bool = False
    note: str = ""


@dataclasses.dataclass(frozen=True)
class Claim:
    """What the paper says of pairs of arms.

    Attributes:
      pairs: (arm said to be better, the other one).
      says: "better"; "par" for at least as good, within the margin; "same" for no difference beyond the margin.
      metrics, splits: on which it is checked, each by itself.
    """

    text: str
    pairs: tuple[tuple[str, str], ...]
    metrics: tuple[str, ...]
    says: str = "better"
    splits: tuple[str, ...] = SPLITS


@dataclasses.dataclass(frozen=True)
class Study:
    """A figure of the paper.

    Attributes:
      figure: of the paper.
      question: in a sentence.
      base: scale -> flags that all arms share.
      metrics: that are reported; the first one ranks the arms.
      curves: of these, those that validation during training knows (name in metrics.jsonl).
      order_kept: whether the paper says that another domain costs image quality and keeps the order of the arms.
    """

    name: str
    figure: str
    question: str
    arms: tuple[Arm, ...]
    base: dict[str, tuple[str, ...]]
    metrics: tuple[str, ...]
    curves: dict[str, str]
    claims: tuple[Claim, ...]
    order_kept: bool = False

    def planned(self, scale: str) -> tuple[Arm, ...]:
        """The arms that a scale trains, each after what it comes after."""
        return tuple(arm for arm in self.arms if arm.smoke or scale != "smoke")


def _base(*flags: str, paper: str) -> dict[str, tuple[str, ...]]:
    town = ("--preset=town", "--steps=400", "--batch=4", "--set", "model.first_guess=training_mean",
            "train.validate_every=200", "train.preview_every=0", "train.validation_windows=8")
    smoke = ("--preset=tiny", "--steps=2", "--set", "train.validate_every=1", "train.preview_every=0",
             "evaluation.windows=2")
    return {"smoke": (*flags, *smoke), "town": (*flags, *town), "paper": (*flags, f"--preset={paper}", "--steps=50000")}


_VARIANTS = {(lidar, camera, fusion): f"{lidar}-{camera}-{fusion}"
             for lidar, camera, fusion in itertools.product(("RV", "PP"), ("WOB", "BEV"), ("TR", "FC", "AVG"))}

FUSION = Study(
    "fusion", "Fig. 3", "Which lidar encoder, camera encoder and fusion predict camera and lidar best?",
    tuple(Arm(name, (f"--variant={name}",), smoke=name == "PP-BEV-AVG") for name in _VARIANTS.values()),
    _base("--latent=1d", "--no-occupancy", paper="paper"), (PSNR, CHAMFER),
    {PSNR: "imagined_psnr_db", CHAMFER: "imagined_chamfer_m"},
    (Claim("range view beats PointPillars",
           tuple((f"RV-{camera}-{fusion}", f"PP-{camera}-{fusion}")
                 for camera in ("WOB", "BEV") for fusion in ("TR", "FC", "AVG")), (PSNR, CHAMFER)),
     Claim("bird's-eye lifting of the camera hurts image prediction",
           tuple((f"{lidar}-WOB-{fusion}", f"{lidar}-BEV-{fusion}")
                 for lidar in ("RV", "PP") for fusion in ("TR", "FC", "AVG")), (PSNR,)),
     Claim("the transformer is on par or better (range view, no lifting)",
           (("RV-WOB-TR", "RV-WOB-FC"), ("RV-WOB-TR", "RV-WOB-AVG")), (PSNR, CHAMFER), "par")),
    order_kept=True)

LATENT = Study(
    "latent", "Fig. 4", "Does a 2D latent, a vision transformer as backbone or a perceptual loss help?",
    (Arm("1D-RN", ("--latent=1d",)),
     Arm("2D-RN", ("--latent=2d",), smoke=True),
     Arm("2D-VIT", ("--latent=2d", "--backbone=mobilevitv2_100")),
     Arm("2D-RN-PL", ("--latent=2d", "--perceptual-from={after}"), after="2D-RN",
         note="the loss network is the image encoder of 2D-RN: no ImageNet weights here")),
    _base("--variant=RV-WOB-TR", paper="paper-occupancy"), (PSNR, CHAMFER, IOU, IOU_EMPTY),
    {PSNR: "imagined_psnr_db", CHAMFER: "imagined_chamfer_m", IOU: "imagined_iou_occ"},
    (Claim("a 2D latent helps the camera", (("2D-RN", "1D-RN"),), (PSNR,)),
     Claim("a 2D latent helps occupancy", (("2D-RN", "1D-RN"),), (IOU,)),
     Claim("a 2D latent does nothing for lidar", (("2D-RN", "1D-RN"),), (CHAMFER,), "same"),
     Claim("a vision transformer helps the camera", (("2D-VIT", "2D-RN"),), (PSNR,)),
     Claim("a perceptual loss does little", (("2D-RN-PL", "2D-RN"),), (PSNR, CHAMFER, IOU), "same")))

OCCUPANCY = Study(
    "occupancy", "Fig. 5 and 6", "Does camera-lidar pre-training help occupancy, and does occupancy help the sensors?",
    (Arm("SENSORS", ("--no-occupancy",), smoke=True, note="camera and lidar alone; what PTF and PTO start from"),
     Arm("PTF", ("--occupancy", "--init={after}", "--set", "train.trainable=decoders_occupancy"), after="SENSORS",
         smoke=True, note="pre-trained, then all but the voxel decoder frozen"),
     Arm("PTO", ("--occupancy", "--init={after}"), after="SENSORS", note="pre-trained, everything trains"),
     Arm("NPT", ("--occupancy",), note="no pre-training")),
    _base("--variant=RV-WOB-TR", "--latent=1d", paper="paper-occupancy"),
    (IOU, IOU_EMPTY, PRECISION, RECALL, PSNR, CHAMFER),
    {IOU: "imagined_iou_occ", PSNR: "imagined_psnr_db", CHAMFER: "imagined_chamfer_m"},
    (Claim("pre-training helps occupancy", (("PTO", "NPT"),), (IOU, RECALL)),
     Claim("a frozen pre-trained model falls behind", (("PTO", "PTF"), ("NPT", "PTF")), (IOU,)),
     Claim("predicting occupancy helps the sensors slightly, or does no harm", (("NPT", "SENSORS"),),
           (PSNR, CHAMFER), "par")))

STUDIES = {study.name: study for study in (FUSION, LATENT, OCCUPANCY)}
