#!/usr/bin/env python3
"""Checks `gakp eval` against TrackEval: every figure of every sequence, and combined, to 4 decimals.

  compare.py GT RESULTS [--det SUFFIX] [--second-half] [--gakp PATH] [--write FILE]

GT, RESULTS     as for `gakp eval`: GT/SEQ/{gt/gt.txt,seqinfo.ini} and RESULTS/SEQ.txt or RESULTS/data/SEQ.txt
--det SUFFIX    only sequences whose names end in -SUFFIX
--second-half   frames after L/2 + 1 only; frame 1 of the results is the first of them
--gakp PATH     the binary (default: gakp)
--write FILE    also write TrackEval's figures, the form of `gakp eval --json`: the expected values of tests/mot_eval.rs

Exits with 1 at a difference. Packages: pip install trackeval==1.3.0 numpy scipy
"""
import argparse, configparser, contextlib, io, json, os, subprocess, sys, tempfile

import trackeval

TOLERANCE = 0.5e-4  # of a percentage: the 4th decimal


def benchmark_of(names, gt):
    kinds = set()
    for name in names:
        with open(os.path.join(gt, name, "gt/gt.txt")) as f:
            kinds.add("MOT15" if f.readline().rstrip().rstrip(",").count(",") >= 9 else "MOT20" if name.startswith("MOT20") else "MOT17")
    if len(kinds) != 1:
        sys.exit(f"{gt} mixes {sorted(kinds)}: TrackEval scores one benchmark a run")
    return kinds.pop()


def prepare(tmp, names, gt, results, second_half):
    """Lays truth and results out as TrackEval wants them; -> frames of every sequence"""
    lengths = {}
    os.makedirs(f"{tmp}/trackers/it/data")
    for name in names:
        ini = configparser.ConfigParser(); ini.optionxform = str
        ini.read(os.path.join(gt, name, "seqinfo.ini"))
        length = int(ini["Sequence"]["seqLength"])
        skip = length // 2 + 1 if second_half else 0
        lengths[name] = length - skip
        os.makedirs(f"{tmp}/gt/{name}/gt")
        with open(os.path.join(gt, name, "gt/gt.txt")) as src, open(f"{tmp}/gt/{name}/gt/gt.txt", "w") as dst:
            for line in src:
                cells = line.strip().split(",")
                if cells[0] and int(float(cells[0])) > skip:
                    dst.write(",".join([str(int(float(cells[0])) - skip)] + cells[1:]) + "\n")
        for place in (f"{name}.txt", f"data/{name}.txt"):
            file = os.path.abspath(os.path.join(results, place))
            if os.path.isfile(file):
                os.symlink(file, f"{tmp}/trackers/it/data/{name}.txt")
                break
        else:
            sys.exit(f"no results for {name} in {results}")
    return lengths


def trackeval_figures(gt, names, results, second_half):
    with tempfile.TemporaryDirectory() as tmp:
        lengths = prepare(tmp, names, gt, results, second_half)
        data = trackeval.datasets.MotChallenge2DBox.get_default_dataset_config()
        data.update(GT_FOLDER=f"{tmp}/gt", TRACKERS_FOLDER=f"{tmp}/trackers", TRACKERS_TO_EVAL=["it"], SKIP_SPLIT_FOL=True,
                    BENCHMARK=benchmark_of(names, gt), SEQ_INFO=lengths, PRINT_CONFIG=False)
        how = trackeval.Evaluator.get_default_eval_config()
        how.update(USE_PARALLEL=False, PRINT_RESULTS=False, PRINT_CONFIG=False, TIME_PROGRESS=False, OUTPUT_SUMMARY=False,
                   OUTPUT_DETAILED=False, OUTPUT_EMPTY_CLASSES=False, PLOT_CURVES=False, BREAK_ON_ERROR=True, LOG_ON_ERROR=None)
        quiet = {"PRINT_CONFIG": False}
        with contextlib.redirect_stdout(io.StringIO()):
            out, _ = trackeval.Evaluator(how).evaluate([trackeval.datasets.MotChallenge2DBox(data)],
                [trackeval.metrics.HOTA(), trackeval.metrics.CLEAR(quiet), trackeval.metrics.Identity(quiet)])
    per = out["MotChallenge2DBox"]["it"]
    return {"sequences": [{"name": n, "frames": lengths[n], **figures(per[n])} for n in names],
            "combined": figures(per["COMBINED_SEQ"])}


def figures(result):
    h, c, i = (result["pedestrian"][k] for k in ("HOTA", "CLEAR", "Identity"))
    mean = lambda k: 100 * float(h[k].mean())
    return {
        "HOTA": mean("HOTA"), "DetA": mean("DetA"), "AssA": mean("AssA"), "MOTA": 100 * float(c["MOTA"]), "IDF1": 100 * float(i["IDF1"]),
        "MT": int(c["MT"]), "ML": int(c["ML"]), "FP": int(c["CLR_FP"]), "FN": int(c["CLR_FN"]), "IDs": int(c["IDSW"]), "Frag": int(c["Frag"]),
        "MOTP": 100 * float(c["MOTP"]), "PT": int(c["PT"]), "TP": int(c["CLR_TP"]), "LocA": mean("LocA"), "DetRe": mean("DetRe"),
        "DetPr": mean("DetPr"), "AssRe": mean("AssRe"), "AssPr": mean("AssPr"), "IDP": 100 * float(i["IDP"]), "IDR": 100 * float(i["IDR"]),
        "IDTP": int(i["IDTP"]), "IDFP": int(i["IDFP"]), "IDFN": int(i["IDFN"]),
    }


def differences(where, theirs, ours):
    if theirs.keys() != ours.keys():
        yield f"{where}: keys {sorted(theirs.keys() ^ ours.keys())} are in one of the two only"
    for key in theirs.keys() & ours.keys():
        a, b = theirs[key], ours[key]
        if (a != b) if isinstance(a, (int, str)) else not abs(a - b) < TOLERANCE:
            yield f"{where}: {key} is {b} here, {a} by TrackEval"


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("gt"); p.add_argument("results"); p.add_argument("--det"); p.add_argument("--second-half", action="store_true")
    p.add_argument("--gakp", default="gakp"); p.add_argument("--write", metavar="FILE")
    a = p.parse_args()
    names = sorted(n for n in os.listdir(a.gt) if os.path.isfile(os.path.join(a.gt, n, "gt/gt.txt")) and (not a.det or n.endswith("-" + a.det)))
    if not names:
        p.error(f"no sequence in {a.gt}")
    theirs = trackeval_figures(a.gt, names, a.results, a.second_half)
    if a.write:
        with open(a.write, "w") as f:
            f.write(json.dumps(theirs, indent=1) + "\n")
    command = [a.gakp, "eval", "--gt", a.gt, "--results", a.results, "--json"]
    command += ["--det", a.det] if a.det else []
    command += ["--second-half"] if a.second_half else []
    run = subprocess.run(command, stdout=subprocess.PIPE)
    if run.returncode:
        sys.exit(f"{' '.join(command)}: exit code {run.returncode}")
    ours = json.loads(run.stdout)
    found = list(differences("combined", theirs["combined"], ours["combined"]))
    if [s["name"] for s in ours["sequences"]] != names:
        found.append(f"sequences {[s['name'] for s in ours['sequences']]} here, {names} by TrackEval")
    for x, y in zip(theirs["sequences"], ours["sequences"]):
        found += differences(x["name"], x, y)
    for line in found:
        print(line)
    count = sum(len(x) for x in [*theirs["sequences"], theirs["combined"]])
    print(f"{a.results}: {len(names)} sequences, {count} values, {len(found)} differences (HOTA {theirs['combined']['HOTA']:.4f}, "
          f"MOTA {theirs['combined']['MOTA']:.4f}, IDF1 {theirs['combined']['IDF1']:.4f})")
    sys.exit(1 if found else 0)


if __name__ == "__main__":
    main()
