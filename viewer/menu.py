"""Keys and the menu bar, both from the table of commands."""

from __future__ import annotations

from functools import cache

from imgui_bundle import imgui

from .keys import COMMANDS, MENUS
from .session import Session

_MODIFIERS = {"Ctrl": imgui.Key.mod_ctrl, "Shift": imgui.Key.mod_shift, "Alt": imgui.Key.mod_alt}
_NAMES = {
    "+": imgui.Key.mod_shift | imgui.Key.equal,
    "=": imgui.Key.equal,
    "-": imgui.Key.minus,
    ".": imgui.Key.period,
    "?": imgui.Key.mod_shift | imgui.Key.slash,
    "1": imgui.Key._1,
    "Keypad 1": imgui.Key.keypad1,
    "Keypad +": imgui.Key.keypad_add,
    "Keypad -": imgui.Key.keypad_subtract,
    "Left": imgui.Key.left_arrow,
    "Right": imgui.Key.right_arrow,
    "Up": imgui.Key.up_arrow,
    "Down": imgui.Key.down_arrow,
}


@cache
def chord(keys: str) -> int:
    """ "Ctrl+O" as Dear ImGui's key chord."""
    if keys in _NAMES:
        return int(_NAMES[keys])
    *modifiers, key = keys.split("+")
    value = int(_NAMES.get(key) or getattr(imgui.Key, key.lower()))
    for modifier in modifiers:
        value |= int(_MODIFIERS[modifier])
    return value


def handle_keys(session: Session) -> None:
    """Act on the keys pressed since the last frame; a text field that is typed into keeps them."""
    typing = imgui.get_io().want_text_input
    for command in COMMANDS:
        if typing and command.keys != ("Escape",):
            continue
        flags = imgui.InputFlags_.route_always
        if command.repeat:
            flags |= imgui.InputFlags_.repeat
        if any(imgui.shortcut(chord(keys), flags) for keys in command.keys) and command.enabled(
            session
        ):
            command.act(session)


def draw(session: Session) -> None:
    """The menu bar; its height is taken off the main viewport's work area."""
    if not imgui.begin_main_menu_bar():
        return
    for menu in MENUS:
        if imgui.begin_menu(menu):
            for command in COMMANDS:
                if (
                    command.menu == menu
                    and imgui.menu_item(
                        command.label,
                        command.keys[0],
                        command.checked(session),
                        command.enabled(session),
                    )[0]
                ):
                    command.act(session)
            imgui.end_menu()
    imgui.end_main_menu_bar()
