"""The studies of the paper: what is queued, what survives a death, and when a claim counts as confirmed."""

import json
import math
import os
import pathlib
import subprocess
import sys
import types

import numpy as np
import pytest
import tyro
from scipy import stats

import muvo_jax
from experiments import run as study_command
from experiments.studies import effects, findings, queue, report, tables
from muvo_jax import command_line, train
from muvo_jax.viz import curves

ROOT = pathlib.Path(muvo_jax.__file__).parents[1]


def _run_of(psnr, chamfer=1.0, step=400, card="card town", mean=10.0):
    scores = {split: {tables.PSNR: {"mean": psnr - drop, "interval": [0, 0]},
                      tables.CHAMFER: {"mean": chamfer, "interval": [0, 0]}}
              for split, drop in zip(tables.SPLITS, (0.0, 1.0), strict=True)}
    return {"steps": step, "parameters": 1000, "processor_s": 36.0, "protocol": "p",
            "cards": dict.fromkeys(tables.SPLITS, card), "scores": scores,
            "baselines": {"training_mean": {split: {tables.PSNR: {"mean": mean}} for split in tables.SPLITS}},
            "curves": {split: {tables.PSNR: [[100, None], [200, psnr - 0.5], [400, psnr]]} for split in tables.SPLITS}}


def _recorded(tmp_path, runs):
    """A folder with results of the study of occupancy from an earlier sitting."""
    out = tmp_path / "out"
    out.mkdir()
    (out / report.RESULTS).write_text(json.dumps(
        {"study": "occupancy", "scale": "town", "data": None, "code": queue.code_fingerprint(), "runs": runs,
         "command": "the first sitting's", "commit": "abc1234", "machine": "m"}))
    return out


@pytest.mark.parametrize("study", tables.STUDIES.values(), ids=list(tables.STUDIES))
@pytest.mark.parametrize("scale", tables.SCALES)
def test_every_arm_is_a_configuration_that_train_takes(study, scale, tmp_path):
    variants = {}
    for job in queue.jobs(study, scale, 1):
        if job.arm.after:
            assert job.arm.after in {arm.name for arm in study.planned(scale)}
            continue
        flags = queue.flags(study, scale, job, tmp_path)
        config, _, folder = train.configure(tyro.cli(train.Options, args=flags))
        assert folder == tmp_path / job.name
        assert config.model.first_guess.kind == ("training_mean" if scale == "town" else "zero")
        variants[job.name] = config.model
    assert len(set(variants.values())) == len(variants)  # no two arms are the same network


def test_memory_is_added_to_the_settings_and_the_run_before_is_that_with_memory(tmp_path):
    arm = next(arm for arm in tables.OCCUPANCY.arms if arm.name == "PTF")
    flags = queue.flags(tables.OCCUPANCY, "town", queue.Job(arm, 1, memory=True), tmp_path)
    settings = flags[flags.index("--set") + 1 :]
    assert "model.first_guess=last_seen" in settings and "model.first_guess=training_mean" not in settings
    assert "train.trainable=decoders_occupancy" in settings
    assert f"--init={tmp_path}/SENSORS+memory-s1" in flags
    assert flags.count("--set") == 1


def test_shards_share_out_all_runs_and_keep_chains_together():
    planned = queue.jobs(tables.OCCUPANCY, "town", 3)
    parts = [queue.of_shard(planned, index, 2) for index in range(2)]
    assert sorted(job.name for part in parts for job in part) == sorted(job.name for job in planned)
    for part in parts:
        names = [job.name for job in part]
        for job in part:
            if job.arm.after:
                assert names.index(f"{job.arm.after}-s{job.seed}") < names.index(job.name)


def test_a_run_that_dies_is_tried_once_more_then_left_out_and_counted(tmp_path, monkeypatch):
    calls, said = [], []

    def dies(command, log):
        calls.append(command)
        log.write_text("boom\n")
        return 1, 2.0

    monkeypatch.setattr(queue, "_run", dies)
    job = queue.jobs(tables.FUSION, "smoke", 1)[0]
    assert not queue.make(tables.FUSION, "smoke", job, tmp_path, said.append)
    assert len(calls) == 2
    assert not queue.make(tables.FUSION, "smoke", job, tmp_path, said.append)
    assert len(calls) == 2 and "left out" in said[-1]
    assert (tmp_path / job.name / queue.LOG).read_text() == "boom\n"
    found = queue.read(tmp_path, job, tables.FUSION)
    assert "died 2 times" in found["died"]
    results = {"runs": {job.label: {"0": found}}, "command": "c", "commit": "d", "code": "e", "machine": "m"}
    report.write(tmp_path / "out", tables.FUSION, results)
    assert "Left out, died twice: PP-BEV-AVG, seed 0 (1 in all)." in (tmp_path / "out" / report.REPORT).read_text()


def test_a_stopped_run_is_resumed_and_a_folder_without_checkpoint_is_set_aside(tmp_path, monkeypatch):
    commands = []

    def finishes(command, log):
        commands.append(command)
        (tmp_path / job.name).mkdir(exist_ok=True)
        (tmp_path / job.name / queue.EVALUATION).write_text("{}")
        return 0, 1.0

    monkeypatch.setattr(queue, "_run", finishes)
    job, other = queue.jobs(tables.FUSION, "town", 1)[:2]
    (tmp_path / job.name / "checkpoints" / "100").mkdir(parents=True)
    assert queue.make(tables.FUSION, "town", job, tmp_path, lambda line: None)
    assert "--resume" in commands[-1]
    job = other
    (tmp_path / job.name).mkdir()
    assert queue.make(tables.FUSION, "town", job, tmp_path, lambda line: None)
    assert "--resume" not in commands[-1]
    assert (tmp_path / f"{job.name}.stopped0").is_dir()


@pytest.mark.parametrize(("low", "high", "says", "expected"), [
    (0.1, 0.3, "better", effects.CONFIRMED), (-0.3, -0.1, "better", effects.CONTRADICTED),
    (-0.1, 0.3, "better", effects.UNDECIDED), (-0.1, 0.3, "par", effects.CONFIRMED),
    (-0.5, -0.3, "par", effects.CONTRADICTED), (-0.1, 0.1, "same", effects.CONFIRMED),
    (0.3, 0.5, "same", effects.CONTRADICTED), (0.1, 0.5, "same", effects.UNDECIDED),
    (math.nan, math.nan, "better", effects.UNDECIDED)])
def test_verdicts(low, high, says, expected):
    assert effects.verdict(low, high, says, margin=0.2) == expected


def test_the_interval_is_students():
    # values 1, 2, 3: mean 2, standard error 1 / sqrt(3), t of two degrees of freedom 4.3027
    mean, low, high = effects.mean_and_interval(np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose([mean, low, high], [2.0, 2.0 - 4.3027 / 3**0.5, 2.0 + 4.3027 / 3**0.5], atol=1e-4)
    assert math.isnan(effects.mean_and_interval(np.array([1.0]))[1])


def test_claims_compare_runs_of_one_seed_and_turn_chamfer_round():
    runs = {f"{lidar}-{camera}-{fusion}": {str(seed): _run_of(20.0 + (lidar == "RV") + 0.3 * seed + 0.1 * place,
                                                              chamfer=1.0 - 0.1 * (lidar == "RV"))
                                           for seed in range(2)}
            for place, (lidar, camera, fusion) in enumerate(
                (lidar, camera, fusion) for lidar in ("RV", "PP") for camera in ("WOB", "BEV")
                for fusion in ("TR", "FC", "AVG"))}
    rows = {(row["claim"], row["metric"], row["split"]): row for row in effects.of_claims(tables.FUSION, runs)}
    beats = rows["range view beats PointPillars", tables.PSNR, "val_rl"]
    assert beats["pairs"] == 12 and beats["effect"] == pytest.approx(1.0 - 0.6)  # six places on
    assert rows["range view beats PointPillars", tables.CHAMFER, "val_ds"]["effect"] == pytest.approx(0.1)
    assert rows["range view beats PointPillars", tables.CHAMFER, "val_ds"]["verdict"] == effects.CONFIRMED
    drop = rows["another domain lowers PSNR", tables.PSNR, "val_rl to val_ds"]
    assert drop["effect"] == pytest.approx(1.0) and drop["verdict"] == effects.CONFIRMED
    order = rows["another domain keeps the order of the arms (Spearman correlation)", tables.PSNR, "val_rl to val_ds"]
    assert order["effect"] == pytest.approx(1.0)
    assert effects.best_and_worst(tables.FUSION, runs) == ("RV-BEV-AVG", "PP-WOB-TR")


@pytest.mark.parametrize("scatter", [0.05, 0.3, 2.0])
def test_as_many_pairs_as_are_said_would_tell_and_one_less_would_not(scatter):
    differences = np.array([0.2 - scatter, 0.2 + scatter])
    count, deviation = effects.pairs_needed(differences, "better", 0.0), differences.std(ddof=1)

    def low(pairs):  # of the interval over so many pairs that scatter alike
        return 0.2 - stats.t.ppf(0.975, pairs - 1) * deviation / np.sqrt(pairs)

    assert low(count) >= 0.0 and count > 2 and low(count - 1) < 0.0


def test_a_claim_of_arms_that_learned_nothing_is_too_short_to_tell_and_how_long_is_said():
    runs = {name: {str(seed): _run_of(psnr + 0.1 * seed, mean=20.0) for seed in range(2)}
            for name, psnr in (("RV-WOB-TR", 20.0), ("PP-WOB-TR", 19.0), ("PP-BEV-TR", 19.0))}
    rows = {(row["metric"], row["split"]): row for row in reversed(effects.of_claims(tables.FUSION, runs))}
    assert rows[tables.PSNR, "val_rl to val_ds"]["verdict"] == effects.TOO_SHORT  # the training mean loses as much
    psnr = rows[tables.PSNR, "val_rl"]
    # 0.2 dB are asked for; the six runs are behind the mean by 0.62 dB on average, and the last doubling gained 0.5 dB
    assert (psnr["verdict"], psnr["updates_needed"]) == (effects.TOO_SHORT, 1200)  # 400 * 2**(0.82 / 0.5)
    assert "; some 1200 updates might do" in report.claims([psnr])[1][0][-1]
    assert rows[tables.CHAMFER, "val_rl"]["verdict"] != effects.TOO_SHORT  # the training mean has none here
    runs["RV-WOB-TR"]["1"] = _run_of(20.3, mean=20.0)
    assert effects.of_claims(tables.FUSION, runs)[0]["verdict"] != effects.TOO_SHORT


def test_the_report_is_one_page_with_its_pictures(tmp_path):
    results = {"runs": {"RV-WOB-TR": {"0": _run_of(20.0), "1": _run_of(21.0)}, "PP-WOB-TR": {"0": _run_of(19.0),
               "1": None}}, "command": "c", "commit": "d", "code": "e", "machine": "m"}
    results["runs"]["PP-WOB-TR"]["0"]["baselines"]["warp_last"] = {"val_rl": {tables.CHAMFER: {"mean": 0.74}}}
    report.write(tmp_path, tables.FUSION, results)
    text, page = (tmp_path / report.REPORT).read_text(), (tmp_path / report.PAGE).read_text()
    assert "| RV-WOB-TR | 2 | 20.500 (20.000..21.000) |" in text
    assert "| training mean |  | 10.000 |  |" in text and "| warp-last |  |  | 0.740 |" in text  # of any run
    assert "Not complete yet: 1 of the planned runs" in text
    assert 'src="data:image/png;base64,' in page and "http" not in page
    assert json.loads((tmp_path / report.RESULTS).read_text()) == results


def test_findings_are_written_between_the_marks(tmp_path):
    page = tmp_path / "README.md"
    page.write_text(f"before\n{findings.BEGIN}\nold\n{findings.END}\nafter\n")
    (tmp_path / "fusion").mkdir()
    runs = {name: {"0": _run_of(psnr), "1": _run_of(psnr + 0.5)}
            for name, psnr in (("RV-WOB-TR", 20.0), ("PP-WOB-TR", 19.0), ("RV-WOB-FC", 21.0))}
    (tmp_path / "fusion" / report.RESULTS).write_text(json.dumps({"runs": runs, "commit": "abc1234"}))
    findings.main(page)
    text = page.read_text()
    assert text.startswith("before\n") and text.endswith("after\n") and "old" not in text
    assert "| range view beats PointPillars | PSNR (dB) | val_rl | 2 | +1.000 |" in text
    assert "### latent: Fig. 4\n\nNo result yet." in text


def test_results_of_other_code_are_refused_and_both_are_named(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(command_line, "prepare_compiler", lambda: None)
    folder = tmp_path / "fusion-smoke"
    folder.mkdir()
    (folder / report.RESULTS).write_text(json.dumps(
        {"study": "fusion", "scale": "smoke", "data": None, "code": "0ld", "commit": "abc1234", "runs": {}}))
    code = command_line.run(study_command.Options, study_command.run, program="run",
                            arguments=["fusion", "--scale=smoke", f"--runs-dir={tmp_path}"])
    error = capsys.readouterr().err
    assert code == 1 and "'0ld' (commit abc1234)" in error and queue.code_fingerprint() in error


def test_runs_that_results_have_scores_of_are_not_made_again_even_where_their_folders_are_gone(
        tmp_path, monkeypatch):
    monkeypatch.setattr(command_line, "prepare_compiler", lambda: None)
    made = []
    monkeypatch.setattr(queue, "make", lambda study, scale, job, *_: made.append(job.name))
    runs = {arm.name: {"0": _run_of(20.0)} for arm in tables.OCCUPANCY.arms if arm.name != "PTF"}
    out = _recorded(tmp_path, runs)
    code = command_line.run(study_command.Options, study_command.run, program="run", arguments=[
        "occupancy", "--seeds=1", f"--runs-dir={tmp_path}", f"--out={out}"])
    assert code == 0
    assert made == ["SENSORS-s0", "PTF-s0"]  # the second starts from the weights of the first
    results = json.loads((out / report.RESULTS).read_text())
    assert results["command"] == "the first sitting's" and results["runs"]["NPT"]["0"]["steps"] == 400
    assert results["runs"]["PTF"]["0"] is None


def test_results_at_both_places_are_held_against_the_study_and_their_runs_put_together(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(command_line, "prepare_compiler", lambda: None)
    out = _recorded(tmp_path, {"NPT": {"0": _run_of(20.0)}})
    here = tmp_path / "occupancy-town"
    here.mkdir()
    text = (out / report.RESULTS).read_text()
    (here / report.RESULTS).write_text(json.dumps(json.loads(text) | {"runs": {"PTO": {"0": _run_of(21.0)}}}))
    call = lambda: command_line.run(study_command.Options, study_command.run, program="run", arguments=[
        "occupancy", "--only-report", "--seeds=1", f"--runs-dir={tmp_path}", f"--out={out}"])
    assert call() == 0
    for place in (here, out):
        kept = report.complete(json.loads((place / report.RESULTS).read_text()))
        assert set(kept) == {"NPT", "PTO"}
    (out / report.RESULTS).write_text(text.replace('"occupancy"', '"fusion"'))
    assert call() == 1 and "holds study 'fusion'" in capsys.readouterr().err
    assert '"fusion"' in (out / report.RESULTS).read_text()


def test_a_recording_without_the_splits_that_are_judged_is_refused_before_anything_trains(
        tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(command_line, "prepare_compiler", lambda: None)
    monkeypatch.setattr(queue, "make", lambda *_: pytest.fail("trained"))
    description = types.SimpleNamespace(splits=("train", "val0", "val1"))
    monkeypatch.setattr(study_command.sources, "open_recording", lambda path: types.SimpleNamespace(
        description=description))
    code = command_line.run(study_command.Options, study_command.run, program="run", arguments=[
        "fusion", f"--data={tmp_path / 'rec'}", f"--runs-dir={tmp_path / 'runs'}"])
    assert code == 1 and not (tmp_path / "runs").exists()
    assert "has the splits train, val0, val1, but a study judges val_rl, val_ds" in capsys.readouterr().err


def test_the_time_of_a_sitting_that_is_interrupted_counts(tmp_path, monkeypatch):
    job = queue.jobs(tables.FUSION, "smoke", 1)[0]
    (tmp_path / job.name).mkdir()
    (tmp_path / job.name / "config.json").touch()

    class Child:
        waits = iter((KeyboardInterrupt, 0))

        def wait(self):
            if (ended := next(self.waits)) is KeyboardInterrupt:
                raise ended
            return ended

    monkeypatch.setattr(queue.subprocess, "Popen", lambda *_, **__: Child())
    used_s = iter((1.0, 6.0))
    monkeypatch.setattr(queue, "_children_s", lambda: next(used_s))
    monkeypatch.setattr(queue, "_set_aside", lambda run: None)
    with pytest.raises(KeyboardInterrupt):
        queue.make(tables.FUSION, "smoke", job, tmp_path, lambda line: None)
    assert json.loads((tmp_path / job.name / queue.COST).read_text()) == {"processor_s": 5.0}


def test_runs_that_were_judged_by_two_cards_are_not_compared(tmp_path):
    with pytest.raises(ValueError, match="on val_rl by card authors and by card town"):
        study_command._check_one_card([_run_of(20.0), _run_of(21.0, card="card authors")], tmp_path)


@pytest.mark.parametrize(("arguments", "message"), [
    (["fuson"], "known are fusion, latent, occupancy. Did you mean fusion"),
    (["fusion", "--scale=twon"], "Did you mean town"), (["fusion", "--shard=2/2"], "an index from 0 to COUNT - 1"),
    (["fusion", "--scale=paper"], "give --data=PATH")])
def test_wrong_words_are_named_with_their_neighbours(arguments, message, capsys, monkeypatch):
    monkeypatch.setattr(command_line, "prepare_compiler", lambda: None)
    assert command_line.run(study_command.Options, study_command.run, program="run", arguments=arguments) == 1
    assert message in capsys.readouterr().err


def test_bands_are_drawn_and_legends_wrap():
    series = {f"an arm with a long name {index}": ([0, 1, 2], [index, index + 1.0, index]) for index in range(4)}
    name = next(iter(series))
    plain = curves.curve(series, "t")
    banded = curves.curve(series, "t", bands={name: ([-1.0, 0.0, -1.0], [1.0, 2.0, 1.0])})
    assert plain.shape == banded.shape and (plain != banded).any()
    rows = {row for row, _ in curves._legend(series, 52, 350).values()}
    assert len(rows) > 1


@pytest.mark.slow
def test_the_smoke_scale_of_all_studies_runs(tmp_path):
    environment = {**os.environ, "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
                   "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "programs"),
                   "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}  # evaluate judges by what training compiled
    for name in tables.STUDIES:
        subprocess.run([sys.executable, "-m", "experiments.run", name, "--scale=smoke", f"--runs-dir={tmp_path}"],
                       cwd=ROOT, env=environment, check=True, timeout=900)
        results = json.loads((tmp_path / f"{name}-smoke" / report.RESULTS).read_text())
        runs = [run for seeds in results["runs"].values() for run in seeds.values()]
        assert len(runs) == len(tables.STUDIES[name].planned("smoke"))
        assert all(run and run["steps"] == 2 and run["scores"]["val_rl"] for run in runs), name
        assert (tmp_path / f"{name}-smoke" / report.CURVES).is_file()


def test_a_score_that_is_not_a_number_ends_no_study(tmp_path):
    """Where no point is predicted, there is no distance; JSON holds it as a text."""
    runs = {"RV-WOB-TR": {"0": _run_of(20.0), "1": _run_of(21.0)},
            "PP-WOB-TR": {"0": _run_of(19.0), "1": _run_of(19.5)}}
    for split in tables.SPLITS:
        runs["PP-WOB-TR"]["0"]["scores"][split][tables.CHAMFER]["mean"] = "nan"
        for seeds in runs.values():
            for run in seeds.values():
                run["baselines"]["training_mean"][split][tables.CHAMFER] = {"mean": 0.5, "interval": [0, 0]}
    runs["RV-WOB-TR"]["1"]["baselines"]["training_mean"]["val_rl"][tables.CHAMFER]["mean"] = "nan"
    report.write(tmp_path, tables.FUSION, {"runs": runs, "command": "c", "commit": "d", "code": "e", "machine": "m"})
    rows = {(row["metric"], row["split"]): row for row in reversed(effects.of_claims(tables.FUSION, runs))}
    assert rows[tables.CHAMFER, "val_ds"]["pairs"] == 1
    assert effects.lead(runs["PP-WOB-TR"]["0"], "val_ds", tables.CHAMFER) == -math.inf


def test_pairs_that_share_an_arm_are_one_difference_for_each_seed():
    """Under no effect at all the interval misses nothing in 5 % of studies; over all pairs it would in 11."""
    claim = next(claim for claim in tables.FUSION.claims if "transformer" in claim.text)
    random, misses, trials = np.random.default_rng(0), 0, 2000
    for _ in range(trials):
        runs = {label: {str(seed): _run_of(random.normal(20.0, 1.0)) for seed in range(3)}
                for label in ("RV-WOB-TR", "RV-WOB-FC", "RV-WOB-AVG")}
        found = effects.differences(claim, runs, "val_rl", tables.PSNR)
        assert found.shape == (3,)
        _, low, high = effects.mean_and_interval(found)
        misses += not low <= 0.0 <= high
    assert 0.035 < misses / trials < 0.065


@pytest.mark.parametrize("flags", [[], ["--no-memory"], ["--seeds=1"], ["--seeds=3"]])
def test_no_call_loses_what_results_hold(tmp_path, monkeypatch, flags):
    monkeypatch.setattr(command_line, "prepare_compiler", lambda: None)
    runs = {arm.name + suffix: {str(seed): _run_of(20.0) for seed in range(2)}
            for arm in tables.OCCUPANCY.arms for suffix in ("", "+memory")}
    out = _recorded(tmp_path, runs)
    code = command_line.run(study_command.Options, study_command.run, program="run", arguments=[
        "occupancy", "--only-report", *flags, f"--runs-dir={tmp_path}", f"--out={out}"])
    assert code == 0
    kept = report.complete(json.loads((out / report.RESULTS).read_text()))
    assert {label: set(seeds) for label, seeds in kept.items()} == {label: {"0", "1"} for label in runs}


def test_what_starts_from_a_run_that_died_waits_for_it(tmp_path):
    arm = next(arm for arm in tables.OCCUPANCY.arms if arm.name == "PTF")
    (tmp_path / "SENSORS-s0").mkdir()
    (tmp_path / "SENSORS-s0" / queue.DIED).write_text("died 2 times")
    said = []
    assert not queue.make(tables.OCCUPANCY, "town", queue.Job(arm, 0), tmp_path, said.append)
    assert said == ["PTF-s0: waits for SENSORS-s0, which died."]
    assert not (tmp_path / "PTF-s0").exists()
