"""Calandra's objects: the authors' lists, the repair of truncated and misspelt names, and the owners' random split.

Sources: github.com/robertocalandra/the-feeling-of-success (repairs, shuffle); github.com/ligerfotis/mvitac (the lists).
"""

import random
from collections.abc import Sequence

_TEST = """international_travel_adapter 3d_printed_blue_connector soft_zebra fake_flower_in_pot metal_can french_dip
metal_cylinder_with_holes soft_beer_bottle_holder"""
_TRAIN = """cinnamon potato aspirin red_turtle happy_fall_stone monster_truck soft_red_cube lime ogx_shampoo peanut_butter
chocolate_shake webcam_box rubics_cube muffin red_bull purple_small_plastic_fruit onion soft_blue_hexagon plastic_cow
fox_head small_coffe_cup lemon red_apple 3d_printed_white_ball set_small_plastic_men_police_man dog_toy_ice_cream_cone
playdoh_container bandaid_box emergency_stop_button_for_sawyer plastic_duck brown_paper_cup_2_upside mentos_gum_can"""
AUTHORS_TEST, AUTHORS_TRAIN = tuple(_TEST.split()), tuple(_TRAIN.split())
"""The paper's 40 most attempted objects as listed by its authors (in their spelling)."""

REPAIRS = {
    "plastic_duc": "plastic_duck",
    "hair_dryer_": "hair_dryer_spiky_nozzle",
    "light_blue_": "light_blue_translucent_object",
    "brown_paper": "brown_paper_bag",
    "beans_in_pa": "beans_in_paper_container",
    "shampoo_whi": "shampoo_white_bottle",
    "small_blue_": "small_blue_plastic_spoon",
    "dove_deodor": "dove_deodorant",
    "yellow_bulb": "yellow_bulb_man",
    "toy_person_with_hat": "set_small_plastic_men_yellow_construction_worker",
}
"""Wrong name in some recordings (cut to 11 letters, or another word) -> object, from the owners' scripts."""


def repaired(name: bytes | str) -> str:
    """Return the name in an attribute object_name, repaired."""
    text = (name.decode() if isinstance(name, bytes) else name).strip(" \0\n\r\t")
    if not text:
        raise ValueError("object_name is empty")
    return REPAIRS.get(text, text)


def owners_shuffle(names: Sequence[str], seed: int) -> list[str]:
    """Shuffle sorted ``names`` like the owners' script: Python 2's random.shuffle after random.seed(seed)."""
    shuffled, generator = sorted(names), random.Random(seed)
    for i in reversed(range(1, len(shuffled))):
        j = int(generator.random() * (i + 1))
        shuffled[i], shuffled[j] = shuffled[j], shuffled[i]
    return shuffled
