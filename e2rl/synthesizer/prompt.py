"""What the language model is told and asked, and how its answer is read (Sec. IV-A2)."""

import json

INSTRUCTIONS = """\
You judge which vehicles in a traffic scene could come into conflict with the ego vehicle within the next five seconds.
You get a description of the ego and of every other vehicle: position and motion seen from the ego, the routes that its
lane offers, and where and when each route meets the ego's route. Judge every vehicle by three criteria, on its own:
- on_lane: it is on the drivable area and belongs to a lane: near the centreline of one of its routes and along it.
- can_meet_ego: one of its routes conflicts with the ego's route or overlaps it, and both can be there at the same time.
- moving_or_blocking: it moves, or it stands in the ego's route closely ahead.
Take the numbers as given and do not guess what is not described. Answer for every vehicle of the list once, by its
number, in the JSON format asked for."""

CRITERIA = ("on_lane", "can_meet_ego", "moving_or_blocking")
Verdicts = dict[int, tuple[bool, ...]]  # of each vehicle: the CRITERIA in order

VEHICLE_SCHEMA = {
    "type": "object",
    "properties": {"id": {"type": "integer"}, **{name: {"type": "boolean"} for name in CRITERIA}},
    "required": ["id", *CRITERIA],
    "additionalProperties": False,
}
SCHEMA = {
    "type": "object",
    "properties": {"vehicles": {"type": "array", "items": VEHICLE_SCHEMA}},
    "required": ["vehicles"],
    "additionalProperties": False,
}


def messages(ego: str, vehicles: dict[int, str]) -> list[dict[str, str]]:
    """The chat of one scene: the instructions, then the descriptions of the ego and of each vehicle."""
    listed = "\n".join(f"- {text}" for text in vehicles.values())
    question = f"{ego}\n{listed}\nJudge vehicles {', '.join(map(str, vehicles))}."
    return [{"role": "system", "content": INSTRUCTIONS}, {"role": "user", "content": question}]


def read_answer(text: str, vehicles: list[int]) -> Verdicts:
    """The verdicts in an answer about `vehicles`.

    Raises ValueError where it is not JSON of the schema, or not about exactly these vehicles.
    """
    try:
        entries = json.loads(text)["vehicles"]
        verdicts = {entry["id"]: tuple(entry[name] for name in CRITERIA) for entry in entries}
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"the answer is not of the schema ({type(error).__name__}: {error})") from error
    if sorted(map(str, verdicts)) != sorted(map(str, vehicles)) or len(entries) != len(vehicles):
        raise ValueError(f"the answer is about vehicles {sorted(map(str, verdicts))}, asked was about {vehicles}")
    if not all(isinstance(value, bool) for verdict in verdicts.values() for value in verdict):
        raise ValueError("the answer holds something else than true and false")
    return verdicts
