"""Plays one player of a game, or all of them, with a controller that hno has exported.

Topics, all std_msgs/Float64MultiArray with ROS times in seconds, for players counted from 1:

    start             in   [time at which the game begins]
    player_<i>/state  in   [time of the measurement, the n states in the game's units and the player's own frame]
    player_<i>/control out [time of the answer, the m controls in the game's units]

Whenever a question makes no sense, see `Controller.refusal`, nothing is published, or the parameter `fallback`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

from hno.runtime import Artefact, ArtefactError, load

PARAMETERS = {"artefact": "", "game": "", "theta": "", "player": 0, "rate": 50.0, "stale": 0.1, "fallback": ""}
"""Names and defaults: the folder; the game that it must be of; one type for each player; whom this node plays, 0 for
all; controls per second; the age at which a state is too old, s; controls that are published instead, none if empty."""


class Controller(Node):
    """The node.

    Raises:
        ArtefactError: the artefact is damaged, of another game or version, or cannot run here.
        ValueError: a parameter makes no sense.
    """

    def __init__(self) -> None:
        super().__init__("hno_controller")
        given = {name: self.declare_parameter(name, default).value for name, default in PARAMETERS.items()}
        self.controller = opened(given["artefact"], given["game"])
        about = self.controller.about
        players, self.horizon = about["players"], about["horizon"]
        self.theta = numbers("theta", given["theta"], players)
        self.stale = positive("stale", given["stale"])
        self.fallback = fallback(given["fallback"], about) if given["fallback"] else None
        if not 0 <= given["player"] <= players:
            raise ValueError(f"player must be 1 to {players}, or 0 for all of them; got {given['player']}.")
        self.plays = [given["player"] - 1] if given["player"] else list(range(players))
        self.start = math.nan
        self.states: dict[int, np.ndarray] = {}
        self.said: str | None = None
        self.outputs = {i: self.create_publisher(Float64MultiArray, f"player_{i + 1}/control", 1) for i in self.plays}
        self.create_subscription(Float64MultiArray, "start", self.begin, 1)
        for i in range(players):
            self.create_subscription(Float64MultiArray, f"player_{i + 1}/state", self.receiver(i), 1)
        self.warn_of_types(*about["type_box"])
        self.create_timer(1 / positive("rate", given["rate"]), self.tick)
        self.get_logger().info(f"plays {[i + 1 for i in self.plays]} of {about['game']}, types {self.theta.tolist()}")

    def warn_of_types(self, low: list[float], high: list[float]) -> None:
        """Say where types lie outside those that were learned."""
        if not ((self.theta >= low) & (self.theta <= high)).all():
            self.get_logger().warning(f"theta lies outside the types {low} to {high}: nothing was learned there")

    def begin(self, message: Float64MultiArray) -> None:
        """The game begins at a time, or is to be forgotten where that is no finite number."""
        self.start = float(message.data[0]) if len(message.data) == 1 else math.nan

    def receiver(self, player: int) -> Callable[[Float64MultiArray], None]:
        """What keeps the last state of a player, sound or not."""

        def receive(message: Float64MultiArray) -> None:
            self.states[player] = np.array(message.data, float)

        return receive

    def refusal(self, now: float) -> str:
        """Why the controller is not asked now; empty if it is."""
        if not math.isfinite(self.start):
            return "no start of the game is known"
        margin = self.controller.about["rounding"] * self.horizon
        if not -margin <= now - self.start <= self.horizon + margin:
            return f"the game lasts {self.horizon:g} s from its start, and this is none of them"
        for player in range(self.controller.about["players"]):
            state = self.states.get(player)
            if state is None or state.shape != (1 + self.controller.about["states"],):
                got = "none" if state is None else f"{len(state)} numbers"
                return f"player {player + 1}: expected a time and {self.controller.about['states']} states, got {got}"
            if not np.isfinite(state).all():
                return f"player {player + 1}: the state is not finite"
            if abs(now - state[0]) > self.stale:
                return f"player {player + 1}: the state is not of the last {self.stale:g} s"
        return ""

    def tick(self) -> None:
        """Answer the states that are known now."""
        now = 1e-9 * self.get_clock().now().nanoseconds
        reason, controls = self.refusal(now), None
        if not reason:
            controls, reason = self.answer(now)
        if controls is None and self.fallback is None:
            self.say(reason, "nothing is published")
            return
        self.say(reason, "the fallback is published" if controls is None else "controls are published")
        for player, output in self.outputs.items():
            u = self.fallback[player] if controls is None else controls[player]
            output.publish(Float64MultiArray(data=[now, *map(float, u)]))

    def answer(self, now: float) -> tuple[np.ndarray | None, str]:
        """Controls of all players (P, m), or None, and what there is to say of them."""
        x = np.stack([self.states[player][1:] for player in sorted(self.states)])
        tau, (low, high) = self.horizon - (now - self.start), np.array(self.controller.about["state_box"])
        try:
            u = self.controller.answers([tau], x[None], self.theta[None])["control"][0]
        except ValueError as error:
            return None, str(error)
        if not np.isfinite(u).all():
            return None, "the controller has no finite answer at this state"
        return u, "" if ((low <= x) & (x <= high)).all() else "the state lies outside the box where it was learned"

    def say(self, reason: str, published: str) -> None:
        """Log what has changed."""
        if reason == self.said:
            return
        self.said = reason
        if reason:
            self.get_logger().warning(f"{reason}: {published}")  # rclpy formats nothing
        else:
            self.get_logger().info(published)


def opened(folder: str, game: str) -> Artefact:
    """The controller in a folder, which must be of the game.

    Raises:
        ArtefactError: it is not, is damaged, or cannot run here.
        ValueError: no game is named.
    """
    if not folder or not game:
        raise ValueError("The parameters artefact (a folder) and game (the name of the game in it) are needed.")
    found = load(folder)
    if found.about["game"] != game:
        raise ArtefactError(f"{folder} is a controller of {found.about['game']!r}, and the parameter game is {game!r}.")
    return found


def numbers(name: str, text: str, count: int) -> np.ndarray:
    """Finite numbers that commas separate, as on hno's command line.

    Raises:
        ValueError: they are not, or not so many.
    """
    try:
        found = np.array([float(part) for part in text.split(",")])
    except ValueError:
        found = np.array([])
    if found.shape != (count,) or not np.isfinite(found).all():
        raise ValueError(f"{name} must be {count} finite numbers with commas between them; got {text!r}.")
    return found


def fallback(text: str, about: Mapping[str, Any]) -> np.ndarray:
    """The same controls for every player, (P, m), inside their boxes.

    Raises:
        ValueError: they are not, or not so many.
    """
    shape = about["players"], about["controls"]
    found, (low, high) = np.broadcast_to(numbers("fallback", text, shape[1]), shape), np.array(about["control_box"])
    if ((found < low) | (found > high)).any():
        raise ValueError(f"fallback must lie in the control box, {low.tolist()} to {high.tolist()}; got {text!r}.")
    return found


def positive(name: str, number: float) -> float:
    """A positive finite number.

    Raises:
        ValueError: it is not.
    """
    if not (math.isfinite(number) and number > 0):
        raise ValueError(f"{name} must be a positive number; got {number}.")
    return number


def main() -> None:
    """Run the node until it is told to end; a wrong artefact or parameter ends it at once, with one line."""
    rclpy.init()
    try:
        node = Controller()
    except (ArtefactError, ValueError) as error:
        rclpy.try_shutdown()
        raise SystemExit(f"hno_controller: {error}") from error
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()
