"""What kind of animal a name means, English or scientific."""

from __future__ import annotations

import re
from collections.abc import Iterable

from torchfra.readers.spelling import name_words

_BIRDS = """
bird birds stork eagle gull goose geese swan duck mallard teal pintail crane heron egret ibis spoonbill flamingo
pelican cormorant gannet booby albatross petrel shearwater fulmar frigatebird tern skua kittiwake puffin guillemot
murre penguin falcon kestrel hawk buzzard kite harrier osprey vulture condor owl cuckoo dove pigeon swallow
godwit curlew plover whimbrel sandpiper oystercatcher lapwing crow raven thrush starling lark bustard grouse
capercaillie accipiter anas anser apus aquila ardea aythya branta bubo buteo calidris calonectris cathartes ciconia
circus clanga columba corvus coragyps cuculus cygnus diomedea falco fregata fulmarus gavia geronticus grus antigone
gypaetus gyps haematopus haliaeetus hieraaetus hirundo larus ichthyaetus leptoptilos limosa macronectes mareca milvus
morus necrosyrtes neophron numenius onychoprion otis pandion pelecanus pernis phalacrocorax phoebastria phoenicopterus
platalea pluvialis procellaria pterodroma puffinus ardenna rissa fratercula uria alca somateria spatula stercorarius
sterna thalassarche streptopelia strix sturnus sula threskiornis torgos trigonoceps turdus tyto vanellus vultur
aegypius chlamydotis
"""
_MARINE = """
turtle turtles tortuga whale dolphin porpoise seal walrus shark ray manta tuna marlin swordfish sunfish salmon
sturgeon dugong manatee eel fish chelonia caretta dermochelys eretmochelys lepidochelys natator balaena balaenoptera
megaptera eubalaena eschrichtius physeter orcinus delphinapterus delphinus tursiops monodon globicephala ziphius
phocoena phoca halichoerus mirounga leptonychotes hydrurga lobodon erignathus cystophora pusa arctocephalus
callorhinus zalophus eumetopias neophoca odobenus carcharodon carcharhinus rhincodon prionace galeocerdo isurus lamna
sphyrna cetorhinus mobula thunnus makaira xiphias mola dugong trichechus anguilla salmo acipenser
"""
_KINDS = dict.fromkeys(_BIRDS.split(), "bird") | dict.fromkeys(_MARINE.split(), "marine animal")
"""Kinds by words of names."""
COLUMNS = {
    "individualtaxoncanonicalname",
    "taxon",
    "taxonname",
    "species",
    "speciesname",
    "scientificname",
    "commonname",
}
"""Plain names of columns that say it."""


def kind_of(names: Iterable[str]) -> str:
    """The kind that all of these mean, ``"bird"`` or ``"marine animal"``; "" where they differ, or one is not known."""
    kinds = {next((_KINDS[word] for word in _words(name) if word in _KINDS), "") for name in names}
    return kinds.pop() if len(kinds) == 1 else ""


def _words(name: str) -> list[str]:
    """The words of a name without the numbers at their ends, the last one first: an eagle ray is a ray."""
    return [re.sub("[0-9]+$", "", word) for word in reversed(name_words(name))]
