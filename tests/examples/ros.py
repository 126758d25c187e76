"""A stand-in for the part of rclpy that examples/ros2_node uses: one clock, topics, timers, parameters and logs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import ModuleType, SimpleNamespace
from typing import Any


class Float64MultiArray:
    """The message; its layout is not used."""

    def __init__(self, data: list[float] | None = None) -> None:
        self.data = data or []
        assert all(type(entry) is float for entry in self.data)  # as the real one insists


class World:
    """Everything that nodes share.

    Args:
        now: ROS time, s.
    """

    def __init__(self, now: float = 1.7e9) -> None:
        self.now = now
        self.parameters: Mapping[str, Any] = {}
        self.listeners: dict[str, list[Callable[[Any], None]]] = {}
        self.timers: list[SimpleNamespace] = []
        self.published: dict[str, list[list[float]]] = {}
        self.logged: list[tuple[str, str]] = []
        self.modules = self._modules()

    def publish(self, topic: str, *data: float) -> None:
        message = Float64MultiArray(list(map(float, data)))
        self.published.setdefault(topic, []).append(message.data)
        for listener in self.listeners.get(topic, []):
            listener(message)

    def advance(self, seconds: float) -> None:
        """Let time go by, and every timer fire when it is due."""
        end = self.now + seconds
        while self.timers and (due := min(timer.due for timer in self.timers)) < end + 1e-6:
            self.now = max(self.now, due)
            for timer in [timer for timer in self.timers if timer.due <= due]:
                timer.due += timer.period
                timer.callback()
        self.now = end

    def _modules(self) -> dict[str, ModuleType]:
        world = self

        class Node:
            """As rclpy.node.Node."""

            def __init__(self, name: str) -> None:
                self.name = name

            def declare_parameter(self, name: str, default: Any) -> SimpleNamespace:
                found = world.parameters.get(name, default)
                assert type(found) is type(default), f"{name} is of the type {type(default)}"
                return SimpleNamespace(value=found)

            def create_publisher(self, kind: type, topic: str, depth: int) -> SimpleNamespace:
                assert kind is Float64MultiArray
                assert depth > 0
                return SimpleNamespace(publish=lambda message: world.publish(topic, *message.data))

            def create_subscription(self, kind: type, topic: str, callback: Callable[[Any], None], depth: int) -> None:
                assert kind is Float64MultiArray
                assert depth > 0
                world.listeners.setdefault(topic, []).append(callback)

            def create_timer(self, period: float, callback: Callable[[], None]) -> None:
                timer = SimpleNamespace(period=period, callback=callback, due=world.now + period)
                world.timers.append(timer)

            def get_clock(self) -> SimpleNamespace:
                return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=round(1e9 * world.now)))

            def get_logger(self) -> SimpleNamespace:
                def logger(kind: str) -> Callable[[str], None]:
                    return lambda text: world.logged.append((kind, text))

                return SimpleNamespace(info=logger("info"), warning=logger("warning"))

        names = ("rclpy", "rclpy.node", "rclpy.executors", "std_msgs", "std_msgs.msg")
        made = {name: ModuleType(name) for name in names}
        made["rclpy.node"].Node = Node
        made["rclpy.executors"].ExternalShutdownException = type("ExternalShutdownException", (Exception,), {})
        made["std_msgs.msg"].Float64MultiArray = Float64MultiArray
        made["rclpy"].init = made["rclpy"].try_shutdown = lambda: None
        return made
