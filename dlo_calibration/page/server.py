# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The server of the page: HTTP and server-sent events on one side, a `Studio` on the other."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from functools import partial
import json
from pathlib import Path
import re
import secrets
import socket
from typing import Any, AsyncIterator, Callable
from urllib.parse import unquote

from aiohttp import web

from dlo_calibration.calibration.result import with_nulls
from dlo_calibration.capture.json_values import parsed
from dlo_calibration.capture.project import OldRevision
from dlo_calibration.errors import InputError
from dlo_calibration.page.guard import BROKEN, Guard, HTTP_LOG, LOG, protect, REPORT_POLICY
from dlo_calibration.page.studio import Studio
from dlo_calibration.vision.board import board_document
from dlo_calibration.vision.film import MAXIMUM_OCTETS

PAGE = Path(__file__).parent / 'static'
TYPES = {'.html': 'text/html', '.css': 'text/css', '.js': 'text/javascript', '.svg': 'image/svg+xml',
         '.png': 'image/png', '.xml': 'application/xml', '.urdf': 'application/xml', '.csv': 'text/csv',
         '.pdf': 'application/pdf', '.mcap': 'application/octet-stream'}
LARGEST_PHOTOGRAPH = 64 * 2**20  # bytes
LARGEST_FILM = MAXIMUM_OCTETS
LARGEST_TEXT = 2 * 2**20  # bytes of anything else
TICK = 0.2  # s between two checks of the background work
PAUSE = 5.0  # s after a check that failed
NAME_LENGTH = 255
ELSEWHERE = '192.0.2.1', 9  # an address that no machine has (RFC 5737), routed like those of other machines
MOST_PAGES = 20  # that listen at the same time
SILENCE = 15.0  # s, after which a comment keeps the connection alive


def serve(studio: Studio, *, host: str = '127.0.0.1', port: int = 0, ready: Callable[[str], None],
          should_stop: Callable[[], bool]) -> None:
    """
    Serve the page of a studio until `should_stop` returns true, and close the studio.

    :param port: 0: any free one.
    :param ready: called with the address of the page, once it can be opened.
    :raises InputError: if the server cannot listen there.
    """
    try:
        asyncio.run(_serve(studio, host, port, ready, should_stop))
    finally:
        studio.close()


async def _serve(studio: Studio, host: str, port: int, ready: Callable[[str], None],
                 should_stop: Callable[[], bool]) -> None:
    token = secrets.token_urlsafe(24)
    guard, events = Guard(host, token), Events()
    runner = web.AppRunner(application(studio, events, guard, token), access_log=None, shutdown_timeout=1.0,
                           logger=HTTP_LOG)
    await runner.setup()
    try:
        site = web.TCPSite(runner, host, port)
        try:
            await site.start()
        except (OSError, OverflowError) as error:
            raise InputError(f'address {host} port {port}', getattr(error, 'strerror', None) or str(error),
                             'a free one on this machine', 'choose another --port') from error
        guard.port = runner.addresses[0][1]
        ready(f'http://{_named(host)}:{guard.port}/{token}/')
        while not should_stop():
            await asyncio.sleep(TICK)
            await _publish(studio, events)
    finally:
        events.close()
        await runner.cleanup()


def _named(host: str) -> str:
    """Return a host as written in an address; for all interfaces, the address that other machines reach."""
    if host in ('0.0.0.0', '::'):
        with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect(ELSEWHERE)  # sends nothing
            return str(probe.getsockname()[0])
        return '127.0.0.1'
    return f'[{host}]' if ':' in host else host


async def _publish(studio: Studio, events: Events) -> None:
    """Send the news of the background work to the open pages."""
    try:
        for name in await asyncio.to_thread(studio.tick):
            events.publish(name, await asyncio.to_thread(getattr(studio, name)))
    except Exception:  # a defect must not end the page, and should not fill the terminal
        LOG.exception('background work')
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
            ('POST', '/api/check', routes.check), ('POST', '/api/stop', routes.stop),
            ('GET', '/api/events', events.answer),
            ('POST', '/api/films', routes.add_film), ('GET', '/api/films/{id}/video', routes.video),
            ('GET', '/api/films/{id}/frame', routes.frame), ('GET', '/api/films/{id}/line', routes.line),
            ('GET', '/api/films/{id}/simulated', routes.simulated),
            ('POST', '/api/films/{id}/follow', routes.follow),
            ('GET', '/api/animation/{number}', routes.animation), ('GET', '/api/files/{name}', routes.file),
            ('GET', '/api/topics', routes.topics), ('POST', '/api/topics', routes.add_topic_image),
            ('POST', '/api/send', routes.send)):
        app.router.add_route(method, base + path, handler)
    return app


class Routes:
    """Answers requests; slow work runs in a thread."""

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
        """Give everything that the page draws."""
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
        """Give a photograph as a JPEG, of any width."""
        width = request.query.get('width')
        if width is not None and not re.fullmatch('[0-9]{1,5}', width):
            raise web.HTTPBadRequest(reason='the width of a picture is a number of pixels')
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
        """Give the document of the board."""
        paper = request.match_info['paper']
        if paper not in ('a4', 'letter'):
            raise web.HTTPNotFound
        return web.Response(body=await asyncio.to_thread(board_document, paper),
                            content_type='application/pdf', headers=_attachment(f'board_{paper}.pdf'))

    async def calibrate(self, request: web.Request) -> web.StreamResponse:
        """Begin to calibrate."""
        return await self._changed(partial(self._studio.calibrate, await _object(request)))

    async def check(self, request: web.Request) -> web.StreamResponse:
        """Compare the trials with a result."""
        octets = await _octets(request, LARGEST_TEXT)
        return await self._answer(partial(self._studio.check, octets, _name(request)))

    async def stop(self, request: web.Request) -> web.StreamResponse:
        """End the calibration with the best so far."""
        return await self._changed(self._studio.stop)

    async def animation(self, request: web.Request) -> web.StreamResponse:
        """Give the simulated motion of a trial."""
        number = request.match_info['number']
        if not re.fullmatch('[0-9]{1,3}', number):
            raise web.HTTPNotFound
        identity = request.query.get('photograph', '')
        return await self._answer(partial(self._studio.animation, int(number), identity))

    async def add_film(self, request: web.Request) -> web.StreamResponse:
        """Take a film, piece by piece."""
        path = await asyncio.to_thread(self._studio.new_film)
        try:
            with path.open('xb') as stream:
                async for piece in _pieces(request, LARGEST_FILM):
                    await asyncio.to_thread(stream.write, piece)
            return await self._changed(partial(self._studio.add_film, path, _name(request)))
        finally:
            path.unlink(missing_ok=True)

    async def video(self, request: web.Request) -> web.StreamResponse:
        """Give the file of a film, or the part of it that the browser wants to play."""
        path = await asyncio.to_thread(self._studio.film_path, request.match_info['id'])
        return web.FileResponse(path, headers={'Content-Type': 'video/mp4'})

    async def frame(self, request: web.Request) -> web.StreamResponse:
        """Give an image of a film as a JPEG."""
        time = request.query.get('time', '0')
        if not re.fullmatch(r'[0-9]{1,5}(\.[0-9]{1,6})?', time):
            raise web.HTTPBadRequest(reason='the time of an image is a number of seconds')
        octets = await asyncio.to_thread(self._studio.film_frame, request.match_info['id'], float(time))
        return web.Response(body=octets, content_type='image/jpeg')

    async def line(self, request: web.Request) -> web.StreamResponse:
        """Give where the DLO was seen in a film."""
        return await self._answer(partial(self._studio.film_line, request.match_info['id']))

    async def simulated(self, request: web.Request) -> web.StreamResponse:
        """Give the simulated DLO over a film."""
        return await self._answer(partial(self._studio.film_simulated, request.match_info['id']))

    async def follow(self, request: web.Request) -> web.StreamResponse:
        """Begin to follow the DLO through a film."""
        return await self._changed(partial(self._studio.follow, request.match_info['id']))

    async def file(self, request: web.Request) -> web.StreamResponse:
        """Give a file to save, or the report to read."""
        name = request.match_info['name']
        octets = await asyncio.to_thread(self._studio.file, name)
        kind = TYPES[Path(name).suffix]
        if name.endswith('.html'):
            return web.Response(body=octets, content_type=kind, charset='utf-8',
                                headers={'Content-Security-Policy': REPORT_POLICY})
        return web.Response(body=octets, content_type=kind, headers=_attachment(name))

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

    async def _answer(self, value: Callable[[], Any]) -> web.StreamResponse:
        return _json(await asyncio.to_thread(value))

    async def _changed(self, act: Callable[[], dict[str, Any]]) -> web.StreamResponse:
        """Change the project in a thread, send the new state to all open pages, and answer with it."""
        answer = await asyncio.to_thread(act)
        self._events.publish('state', answer.get('state', answer))
        return _json(answer)


async def _octets(request: web.Request, most: int) -> bytes:
    """Return the content of a request; refuse a large one before it is all in memory."""
    return b''.join([piece async for piece in _pieces(request, most)])


async def _pieces(request: web.Request, most: int) -> AsyncIterator[bytes]:
    """Give the content of a request piece by piece; refuse a large one."""
    def check(count: int) -> None:
        if count > most:
            raise web.HTTPRequestEntityTooLarge(
                most, count, reason=f'the content has more than {most / 1e6:.0f} MB; send a smaller file')

    check(request.content_length or 0)
    count = 0
    try:
        async for piece in request.content.iter_any():
            count += len(piece)
            check(count)
            yield piece
    except BROKEN as error:
        raise web.HTTPBadRequest(
            reason='the content is damaged, or ended too early; send it again') from error


async def _object(request: web.Request) -> dict[str, Any]:
    """Return the JSON object in a request; an empty one for an empty request."""
    octets = await _octets(request, LARGEST_TEXT)
    if not octets:
        return {}
    if request.content_type != 'application/json':
        raise web.HTTPUnsupportedMediaType(reason='the content is no JSON; send it as application/json')
    try:
        value = parsed(octets)
    except (ValueError, RecursionError) as error:
        raise web.HTTPBadRequest(reason='the content is damaged JSON; load the page again') from error
    if not isinstance(value, dict):
        raise web.HTTPBadRequest(reason='the content is no JSON object; load the page again')
    return value


def _word(given: dict[str, Any], name: str) -> str:
    value = given.get(name)
    if not isinstance(value, str) or not 0 < len(value) <= NAME_LENGTH:
        raise web.HTTPBadRequest(
            reason=f'{name} is missing, or is no text of at most {NAME_LENGTH} characters')
    return value


def _name(request: web.Request) -> str:
    """Return the file name in the header of a request; it is only shown."""
    return unquote(request.headers.get('X-Name', ''), errors='replace')[:NAME_LENGTH]


def _attachment(name: str) -> dict[str, str]:
    """Return the header of a file that the browser saves."""
    return {'Content-Disposition': f'attachment; filename="{name}"'}


def _json(value: dict[str, Any], status: int = 200) -> web.Response:
    return web.Response(body=json.dumps(with_nulls(value), allow_nan=False).encode(), status=status,
                        content_type='application/json')


class Events:
    """The events for the open pages; a slow page gets only the newest event of each name."""

    def __init__(self) -> None:
        self._waiting: dict[int, dict[str, bytes]] = {}  # page -> name -> the newest event
        self._news: dict[int, asyncio.Event] = {}
        self._closed = False

    def publish(self, name: str, value: Any) -> None:
        """Send an event to all pages; a list becomes one event for each of its values."""
        values = value if isinstance(value, list) else [value]
        data = [json.dumps(with_nulls(event), allow_nan=False) for event in values]
        octets = ''.join(f'event: {name}\ndata: {event}\n\n' for event in data).encode()
        for page, waiting in self._waiting.items():
            waiting[name] = octets
            self._news[page].set()

    def close(self) -> None:
        """End the answers to all pages."""
        self._closed = True
        for news in self._news.values():
            news.set()

    async def answer(self, request: web.Request) -> web.StreamResponse:
        """Answer a page that listens, until it is closed."""
        if len(self._waiting) >= MOST_PAGES:
            raise web.HTTPConflict(reason=f'{MOST_PAGES} pages are open already; close some')
        page = id(request)
        waiting, news = self._waiting.setdefault(page, {}), self._news.setdefault(page, asyncio.Event())
        answer = web.StreamResponse(headers={'Content-Type': 'text/event-stream'})
        protect(answer)
        try:
            await answer.prepare(request)
            await answer.write(b': connected\n\n')
            while not self._closed:
                try:
                    await asyncio.wait_for(news.wait(), SILENCE)
                except TimeoutError:
                    await answer.write(b': still here\n\n')
                    continue
                news.clear()
                while waiting:
                    await answer.write(waiting.pop(next(iter(waiting))))
        except ConnectionResetError:  # the page was closed
            pass
        finally:
            del self._waiting[page], self._news[page]
        return answer
