"""Run Firefox for Playwright and answer the commands that a stock Firefox does not know.

Playwright speaks WebDriver BiDi with a stock Firefox, but sets media features by a command that
Firefox ESR lacks. This program is started in place of Firefox: it starts Firefox and passes all
messages on, except that command, to which it replies that it is done.

    python firefox_bridge.py FIREFOX ARGUMENTS...
"""

from __future__ import annotations

import asyncio
import json
import re
import signal
import sys
from functools import partial

import websockets
from websockets.asyncio.client import connect
from websockets.asyncio.server import serve

UNKNOWN = {"emulation.setMediaFeaturesOverride"}
"""Commands that Firefox does not know and that no test needs."""
LISTENING = re.compile(r"WebDriver BiDi listening on (ws://[\d.]+:\d+)")


async def main(firefox: str, arguments: list[str]) -> int:
    """Run Firefox until it ends; return its exit status."""
    process = await asyncio.create_subprocess_exec(
        firefox, *arguments, stderr=asyncio.subprocess.PIPE
    )
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, process.terminate)
    assert process.stderr is not None
    server = None
    while line := (await process.stderr.readline()).decode(errors="replace"):
        found = LISTENING.search(line)
        if found and server is None:
            server = await serve(partial(bridge, address=found[1]), "127.0.0.1", 0, max_size=None)
            port = server.sockets[0].getsockname()[1]
            line = f"WebDriver BiDi listening on ws://127.0.0.1:{port}\n"
        sys.stderr.write(line)
        sys.stderr.flush()
    return await process.wait()


async def bridge(playwright: websockets.ServerConnection, address: str) -> None:
    """Pass messages between a connection of Playwright and Firefox."""
    path = playwright.request.path if playwright.request else "/session"
    async with connect(f"{address}{path}", max_size=None) as firefox:

        async def to_firefox() -> None:
            async for message in playwright:
                command = json.loads(message)
                if command.get("method") in UNKNOWN:
                    done = {"type": "success", "id": command["id"], "result": {}}
                    await playwright.send(json.dumps(done))
                else:
                    await firefox.send(message)
            await firefox.close()

        async def to_playwright() -> None:
            async for message in firefox:
                await playwright.send(message)
            await playwright.close()

        await asyncio.gather(to_firefox(), to_playwright())


if __name__ == "__main__":
    sys.exit(asyncio.run(main(sys.argv[1], sys.argv[2:])))
