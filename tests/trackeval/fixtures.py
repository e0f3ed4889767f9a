#!/usr/bin/env python3
"""Makes small MOTChallenge sequences and results of a bad tracker: our own, drawn by a seeded generator.

  fixtures.py OUT [--seed N] [--sequences N] [--mot15]

Writes OUT/gt/SEQ/{gt/gt.txt,seqinfo.ini} and OUT/results/SEQ.txt. They hold what is easily got wrong:
occlusions, identity switches, fragments, false alarms, crowds on a coarse grid (equal overlaps, an IoU
of exactly one half), the same truth box twice, all classes, truth that does not count, frames without
truth or results, rows out of order, and (every fourth sequence) no results at all.

The fixtures of the tests, from the root of the repository:
  fixtures.py tests/fixtures/mot/classes --seed 1 && fixtures.py tests/fixtures/mot/mot15 --seed 2 --sequences 3 --mot15
  for d in classes mot15; do compare.py tests/fixtures/mot/$d/gt tests/fixtures/mot/$d/results --write tests/fixtures/mot/$d/expected.json; done
"""
import argparse, os, random

LENGTH = 30


def people(rng, grid, classes):
    """-> [(identity, class, counts, {frame: (x, y, w, h)})]"""
    out = []
    for identity in range(1, rng.randint(5, 10)):
        kind = rng.choices([1, 2, 3, 6, 7, 8, 9, 12], [14, 1, 1, 1, 2, 1, 1, 1])[0]
        x, y, w, h = rng.randrange(0, 160, grid), rng.randrange(0, 60, grid), 20, 40
        dx, dy = rng.choice([-4, -2, 0, 2, 4]), rng.choice([-1, 0, 0, 1])
        first, last = rng.randint(1, 8), rng.randint(18, LENGTH)
        gone = range(*sorted(rng.sample(range(first, last), 2))) if rng.random() < 0.3 else ()
        boxes = {t: (x + dx * (t - first), y + dy * (t - first), w, h) for t in range(first, last + 1) if t not in gone}
        out.append((identity, kind, int((kind == 1 or not classes) and rng.random() < 0.9), boxes))
        if rng.random() < 0.25:  # the same boxes once more, as another class
            out.append((identity + 20, rng.choice([1, 7]), int(rng.random() < 0.5), dict(boxes)))
    return out


def track(rng, truth, grid):
    """A tracker that sees every class, misses, shifts, swaps, splits and invents -> [(frame, id, x, y, w, h)]"""
    rows, names, following = [], {}, 1
    for t in range(1, LENGTH + 1):
        if rng.random() < 0.06:
            continue
        if len(names) > 1 and rng.random() < 0.08:  # swap two identities
            a, b = rng.sample(sorted(names), 2)
            names[a], names[b] = names[b], names[a]
        taken = set()
        for identity, _, _, boxes in truth:
            if t not in boxes or rng.random() < 0.15:
                continue
            if identity not in names or rng.random() < 0.05:  # born, or split
                names[identity], following = following, following + 1
            x, y, w, h = boxes[t]
            shift = rng.choice([0] * 6 + [2, 4, 20 / 3, 10, -2])  # 20 / 3: an IoU of one half
            if rng.random() < 0.3:
                shift, w, h = shift + rng.uniform(-1, 1), w + rng.uniform(-2, 2), h + rng.uniform(-4, 4)
            if names[identity] not in taken:
                taken.add(names[identity])
                rows.append((t, names[identity], x + shift, y, w, h))
        if rng.random() < 0.2:
            rows.append((t, following, rng.randrange(0, 200, grid), rng.randrange(0, 80, grid), 20, 40))
            following += 1
    return rows


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("out"); p.add_argument("--seed", type=int, default=1); p.add_argument("--sequences", type=int, default=4)
    p.add_argument("--mot15", action="store_true")
    a = p.parse_args()
    rng = random.Random(a.seed)
    os.makedirs(os.path.join(a.out, "results"), exist_ok=True)
    for number in range(1, a.sequences + 1):
        name, grid = f"SEQ-{number:02d}", rng.choice([2, 10, 20])
        folder = os.path.join(a.out, "gt", name)
        os.makedirs(os.path.join(folder, "gt"), exist_ok=True)
        with open(os.path.join(folder, "seqinfo.ini"), "w") as f:
            f.write(f"[Sequence]\nname={name}\nimDir=img1\nframeRate=10\nseqLength={LENGTH}\nimWidth=200\nimHeight=100\nimExt=.jpg\n")
        truth = people(rng, grid, not a.mot15)
        with open(os.path.join(folder, "gt/gt.txt"), "w") as f:
            for identity, kind, counts, boxes in truth:
                for t, box in boxes.items():
                    tail = "-1,-1,-1" if a.mot15 else f"{kind},{rng.randint(0, 10) / 10}"
                    f.write("%d,%d,%d,%d,%d,%d,%d,%s\n" % (t, identity, *box, counts, tail))
        rows = track(rng, truth, grid) if number % 4 else []
        if number % 2:
            rng.shuffle(rows)
        with open(os.path.join(a.out, "results", name + ".txt"), "w") as f:
            f.writelines("%d,%d,%.2f,%.2f,%.2f,%.2f,1,-1,-1,-1\n" % row for row in rows)


if __name__ == "__main__":
    main()
