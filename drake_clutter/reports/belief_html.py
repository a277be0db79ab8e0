"""What unseen space may hide, as HTML of an episode's page."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from drake_clutter.reports.scene_images import display_name


def belief_html(hidden: Mapping[str, Any], heading: str) -> str:
    """Return the belief at a decision.

    Args:
        hidden: Document of the belief, see `HiddenBelief.to_dict`.
        heading: Text before the probability.
    """
    probability = hidden["nothing_left"]
    bar = (
        '<div class="bars"><div class="bar"><span>Every object is known</span><span class="track">'
        f'<b style="width:{100 * probability:.1f}%"></b></span>'
        f"<span>{100 * probability:.3g} %</span></div></div>"
    )
    reasons = [_support_text(support) for support in hidden["supports"]]
    if points := hidden["unidentified_points"]:
        reasons.append(f"{points} depth points belong to no known object.")
    room = [name for name, area in hidden["areas"].items() if area > 0]
    if room:
        reasons.append(f"Room for an unseen object on the floor: {_class_names(room)}.")
    items = "".join(f"<li>{escape(reason)}</li>" for reason in reasons)
    return f"<h4>{escape(heading)}</h4>{bar}" + (f'<ul class="soft">{items}</ul>' if items else "")


def _support_text(support: Mapping[str, Any]) -> str:
    """Return a sentence about what carries a known object."""
    verb = "stands" if support["is_certain"] else "may stand"
    classes = _class_names(support["classes"])
    if not classes:
        return (
            f"{display_name(support['carried'])} {verb} on nothing known, but no class fits below."
        )
    return (
        f"{display_name(support['carried'])} {verb} on something hidden, "
        f"{1000 * support['gap']:.0f} mm above what is known below; there fits: {classes}."
    )


def _class_names(names: Sequence[str]) -> str:
    return ", ".join(display_name(name) for name in names)
