# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The server of the page: HTTP on one side, a `Studio` on the other."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from functools import partial
import json
from pathlib import Path
import re
import secrets
import socket
from tempfile import TemporaryDirectory
from typing import Any, Callable
from urllib.parse import unquote

from aiohttp import web

from dlo_calibration.calibration.plain import known
from dlo_calibration.capture.connections import Connections
from dlo_calibration.capture.events import Events
from dlo_calibration.capture.guard import Guard, LOG, Refused, REPORT_POLICY
from dlo_calibration.capture.project import OldRevision, Project
from dlo_calibration.capture.studio import Studio
from dlo_calibration.errors import InputError

PAGE = Path(__file__).parent / 'page'
TYPES = {'.html': 'text/html', '.css': 'text/css', '.js': 'text/javascript', '.svg': 'image/svg+xml',
         '.png': 'image/png', '.xml': 'application/xml', '.csv': 'text/csv', '.pdf': 'application/pdf',
         '.mcap': 'application/octet-stream'}
LARGEST_PHOTOGRAPH = 64 * 2**20  # bytes
LARGEST_TEXT = 2 * 2**20  # bytes of anything else
TICK = 0.2  # s between two looks at what happens in the background
PAUSE = 5.0  # s after a look that failed
NAME_LENGTH = 255
ELSEWHERE = '192.0.2.1', 9  # an address that no machine has (RFC 5737), but the way to others leads there


def serve(project: Project, connections: Connections, *, host: str = '127.0.0.1', port: int = 0,
          ready: Callable[[str], None], should_stop: Callable[[], bool]) -> None:
    """
    Serve the page of a project until `should_stop` returns true.

    :param port: 0: one that is free.
    :param ready: called with the address of the page, when it can be opened.
    :raises InputError: if the server cannot listen there.
    """
    studio = Studio(project, connections)
    try:
        asyncio.run(_serve(studio, host, port, ready, should_stop))
    finally:
        studio.close()


async def _serve(studio: Studio, host: str, port: int, ready: Callable[[str], None],
                 should_stop: Callable[[], bool]) -> None:
    token = secrets.token_urlsafe(24)
    guard, events = Guard(host, token), Events()
    runner = web.AppRunner(application(studio, events, guard, token), access_log=None, shutdown_timeout=1.0)
    await runner.setup()
    try:
        site = web.TCPSite(runner, host, port)
        try:
            await site.start()
        except (OSError, OverflowError) as error:
            raise InputError(f'address {host} port {port}', getattr(error, 'strerror', None) or str(error),
                             'one that is free on this machine', 'choose another --port') from error
        guard.port = runner.addresses[0][1]
        ready(f'http://{_named(host)}:{guard.port}/{token}/')
        while not should_stop():
            await asyncio.sleep(TICK)
            await _tell(studio, events)
    finally:
        events.close()
        await runner.cleanup()


def _named(host: str) -> str:
    """Return an address as it stands in a page's; for all of this machine's, the one that others know."""
    if host in ('0.0.0.0', '::'):
        with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect(ELSEWHERE)  # sends nothing
            return str(probe.getsockname()[0])
        return '127.0.0.1'
    return f'[{host}]' if ':' in host else host


async def _tell(studio: Studio, events: Events) -> None:
    """Tell the open pages what happened in the background."""
    try:
        for name in await asyncio.to_thread(studio.tick):
            events.tell(name, await asyncio.to_thread(getattr(studio, name)))
    except Exception:  # a defect must not end the page, and should not fill the terminal
        LOG.exception('what happened in the background')
        await asyncio.sleep(PAUSE)


def application(studio: Studio, events: Events, guard: Guard, token: str) -> web.Application:
    """Return the server's application."""
    routes = Routes(studio, events)
    app = web.Application(middlewares=[guard.answer], client_max_size=LARGEST_PHOTOGRAPH)
    base = f'/{token}'
    for method, path, handler in (
            ('GET', '/', routes.page), ('GET', '/page/{name}', routes.page),
            ('GET', '/api/state', routes.state), ('PUT', '/api/document', routes.change),
            ('POST', '/api/photographs', routes.add_photograph),
            ('GET', '/api/photographs/{id}/picture', routes.picture),
            ('POST', '/api/lens', routes.set_lens), ('DELETE', '/api/lens', routes.remove_lens),
            ('GET', '/api/board/{paper}.pdf', routes.board), ('POST', '/api/calibrate', routes.calibrate),
            ('POST', '/api/stop', routes.stop), ('GET', '/api/events', events.answer),
            ('GET', '/api/film/{number}', routes.film), ('GET', '/api/files/{name}', routes.file),
            ('GET', '/api/topics', routes.topics), ('POST', '/api/topics', routes.add_topic_image),
            ('POST', '/api/send', routes.send)):
        app.router.add_route(method, base + path, handler)
    return app


class Routes:
    """Answers requests; whatever takes time is done in a thread."""

    def __init__(self, studio: Studio, events: Events) -> None:
        self._studio, self._events = studio, events
        self._pages = {file.name: file for file in PAGE.glob('*') if file.suffix in TYPES}

    async def page(self, request: web.Request) -> web.StreamResponse:
        """Give the page, or one of its files."""
        file = self._pages.get(request.match_info.get('name', 'index.html'))
        if file is None:
            raise web.HTTPNotFound
        return web.Response(body=await asyncio.to_thread(file.read_bytes), content_type=TYPES[file.suffix],
                            charset='utf-8' if TYPES[file.suffix].startswith('text/') else None)

    async def state(self, request: web.Request) -> web.StreamResponse:
        """Give all that the page draws."""
        return await self._answer(self._studio.state)

    async def change(self, request: web.Request) -> web.StreamResponse:
        """Take a changed document."""
        given = await _object(request)
        try:
            return await self._changed(partial(
                self._studio.change, given.get('document'), given.get('revision')))
        except OldRevision as error:
            state = await asyncio.to_thread(self._studio.state)
            return _json({'error': str(error), 'state': state}, status=409)

    async def add_photograph(self, request: web.Request) -> web.StreamResponse:
        """Take a photograph."""
        octets = await _octets(request, LARGEST_PHOTOGRAPH)
        return await self._changed(partial(self._studio.add_photograph, octets, _name(request)))

    async def picture(self, request: web.Request) -> web.StreamResponse:
        """Give a photograph as a JPEG of any width."""
        width = request.query.get('width')
        if width is not None and not re.fullmatch('[0-9]{1,5}', width):
            raise Refused(400, 'the width of a picture is a number of pixels')
        octets = await asyncio.to_thread(self._studio.picture, request.match_info['id'],
                                         int(width) if width else None)
        return web.Response(body=octets, content_type='image/jpeg',
                            headers={'Cache-Control': 'private, max-age=31536000, immutable'})

    async def set_lens(self, request: web.Request) -> web.StreamResponse:
        """Take a camera calibration."""
        octets = await _octets(request, LARGEST_TEXT)
        return await self._changed(partial(self._studio.set_lens, octets, _name(request)))

    async def remove_lens(self, request: web.Request) -> web.StreamResponse:
        """Forget the camera calibration."""
        return await self._changed(self._studio.remove_lens)

    async def board(self, request: web.Request) -> web.StreamResponse:
        """Give the board to be printed."""
        paper = request.match_info['paper']
        if paper not in ('a4', 'letter'):
            raise web.HTTPNotFound
        return web.Response(body=await asyncio.to_thread(board_document, paper),
                            content_type='application/pdf', headers=_saved(f'board_{paper}.pdf'))

    async def calibrate(self, request: web.Request) -> web.StreamResponse:
        """Begin to calibrate."""
        return await self._changed(partial(self._studio.calibrate, await _object(request)))

    async def stop(self, request: web.Request) -> web.StreamResponse:
        """End the calibration with the best so far."""
        return await self._changed(self._studio.stop)

    async def film(self, request: web.Request) -> web.StreamResponse:
        """Give the simulated motion of a trial."""
        number = request.match_info['number']
        if not re.fullmatch('[0-9]{1,3}', number):
            raise web.HTTPNotFound
        identity = request.query.get('photograph', '')
        return await self._answer(partial(self._studio.film, int(number), identity))

    async def file(self, request: web.Request) -> web.StreamResponse:
        """Give a file to save, or the report to be read."""
        name = request.match_info['name']
        octets = await asyncio.to_thread(self._studio.file, name)
        kind = TYPES[Path(name).suffix]
        if name.endswith('.html'):
            return web.Response(body=octets, content_type=kind, charset='utf-8',
                                headers={'Content-Security-Policy': REPORT_POLICY})
        return web.Response(body=octets, content_type=kind, headers=_saved(name))

    async def topics(self, request: web.Request) -> web.StreamResponse:
        """Give the ROS topics with images."""
        return _json({'topics': await asyncio.to_thread(self._studio.topics)})

    async def add_topic_image(self, request: web.Request) -> web.StreamResponse:
        """Take the newest image of a topic."""
        topic = _word(await _object(request), 'name')
        return await self._changed(partial(self._studio.add_topic_image, topic))

    async def send(self, request: web.Request) -> web.StreamResponse:
        """Send the trials to a running calibrator."""
        namespace = _word(await _object(request), 'namespace')
        return _json({'text': await asyncio.to_thread(self._studio.send, namespace)})

    async def _answer(self, what: Callable[[], Any]) -> web.StreamResponse:
        return _json(await asyncio.to_thread(what))

    async def _changed(self, act: Callable[[], dict[str, Any]]) -> web.StreamResponse:
        """Do something in a thread, tell all open pages the new state, and answer with it."""
        answer = await asyncio.to_thread(act)
        self._events.tell('state', answer.get('state', answer))
        return _json(answer)


def board_document(paper: str) -> bytes:
    """Return the PDF document of a board."""
    from dlo_calibration.capture.board_sheet import write_board  # Matplotlib loads slowly

    with TemporaryDirectory() as folder:
        path = Path(folder) / 'board.pdf'
        write_board(path, paper)
        return path.read_bytes()


async def _octets(request: web.Request, most: int) -> bytes:
    """Return the content of a request; refuse a large one before it is all in memory."""
    refused = Refused(413, f'what was sent has more than {most / 1e6:.0f} MB; send a smaller file')
    if (request.content_length or 0) > most:
        raise refused
    pieces, count = [], 0
    async for piece in request.content.iter_any():
        pieces.append(piece)
        count += len(piece)
        if count > most:
            raise refused
    return b''.join(pieces)


async def _object(request: web.Request) -> dict[str, Any]:
    """Return the JSON object that was sent; an empty one where nothing was."""
    octets = await _octets(request, LARGEST_TEXT)
    if not octets:
        return {}
    if request.content_type != 'application/json':
        raise Refused(415, 'what was sent is no JSON; send it as application/json')
    try:
        value = json.loads(octets, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise Refused(400, 'what was sent is no JSON that can be read; load the page again') from error
    if not isinstance(value, dict):
        raise Refused(400, 'what was sent is no JSON object; load the page again')
    return value


def _no_constant(name: str) -> float:
    raise ValueError(name)


def _word(given: dict[str, Any], name: str) -> str:
    value = given.get(name)
    if not isinstance(value, str) or not 0 < len(value) <= NAME_LENGTH:
        raise Refused(400, f'{name} is missing, or is no text of at most {NAME_LENGTH} characters')
    return value


def _name(request: web.Request) -> str:
    """Return the file name that the page tells; it is only shown."""
    return unquote(request.headers.get('X-Name', ''), errors='replace')[:NAME_LENGTH]


def _saved(name: str) -> dict[str, str]:
    """Return the header of a file that the browser saves."""
    return {'Content-Disposition': f'attachment; filename="{name}"'}


def _json(value: dict[str, Any], status: int = 200) -> web.Response:
    return web.Response(body=json.dumps(known(value), allow_nan=False).encode(), status=status,
                        content_type='application/json')
