# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Guard: refuses the requests of other pages, and adds the headers of every answer."""

from __future__ import annotations

import hmac
import ipaddress
import logging
from typing import Awaitable, Callable

from aiohttp import web
from aiohttp.http import HttpProcessingError

from dlo_calibration.errors import DEFECT, DloCalibrationError, safe_line
from dlo_calibration.page.studio import UnknownName

LOG = logging.getLogger('dlo_calibration')
#: The log of aiohttp's server, without the tracebacks that it writes for broken requests.
HTTP_LOG = logging.getLogger('dlo_calibration.http')
#: Exceptions for a request that is no HTTP, is damaged, or whose connection ends too early.
BROKEN = (HttpProcessingError, web.RequestPayloadError, ConnectionError)

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

#: The page may load and reach only its own server.
POLICY = ("default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
          "connect-src 'self'; media-src 'self' blob:; base-uri 'none'; form-action 'none'; "
          "frame-ancestors 'none'")
#: The report needs nothing of this server: it gets an origin of its own.
REPORT_POLICY = ("sandbox allow-popups; default-src 'none'; style-src 'unsafe-inline'; img-src data:; "
                 "base-uri 'none'; form-action 'none'; frame-ancestors 'none'")
HEADERS = {
    'X-Content-Type-Options': 'nosniff',
    'Referrer-Policy': 'no-referrer',
    'Cross-Origin-Opener-Policy': 'same-origin',
    'Cross-Origin-Resource-Policy': 'same-origin',
    'Permissions-Policy': 'camera=(self), geolocation=(), microphone=()',
}
LOOPBACK = ('127.0.0.1', 'localhost', '[::1]')
NOT_FOUND = 'there is nothing at this address; open the one that dlo-calibration capture printed'


HTTP_LOG.addFilter(lambda record: not (record.exc_info and isinstance(record.exc_info[1], BROKEN)))



class Guard:
    """
    Refuses requests that do not come from our page.

    :param host: name or address that the server listens on.
    :param token: secret that only its user knows.
    """

    def __init__(self, host: str, token: str) -> None:
        self._host, self._token = host, token.encode()
        self.port = 0  # known when the server listens

    @web.middleware
    async def answer(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Answer a request, or refuse it."""
        try:
            self._check(request)
            answer = await handler(request)
        except web.HTTPException as error:
            answer = refusal(error.status, NOT_FOUND if error.status == 404 else error.reason)
        except DloCalibrationError as error:
            answer = refusal(404 if isinstance(error, UnknownName) else 400, str(error))
        except Exception as error:  # a defect must not look like a lost connection
            LOG.exception('request %s', request.path.rpartition('/')[2])
            answer = refusal(500, f'{type(error).__name__}: {error}; {DEFECT}')
        if not answer.prepared:
            protect(answer)
        return answer

    def _check(self, request: web.Request) -> None:
        host = request.headers.get('Host', '')
        if not self._is_ours(host):
            raise web.HTTPForbidden(
                reason='the address of this page has another host; open the one that was printed')
        token = request.path.lstrip('/').partition('/')[0].encode('utf-8', 'surrogatepass')
        if not hmac.compare_digest(token, self._token):
            raise web.HTTPNotFound
        origin = request.headers.get('Origin')
        site = request.headers.get('Sec-Fetch-Site', 'none')
        if (origin is not None and origin != f'http://{host}') or site not in ('none', 'same-origin'):
            raise web.HTTPForbidden(reason='another page asked for this; only the page of this server may')

    def _is_ours(self, host: str) -> bool:
        """Tell whether the host of a request is that of the server."""
        name, _, port = host.lower().rpartition(':')
        if port != str(self.port):
            return False
        if name in LOOPBACK or name.strip('[]') == self._host.lower():
            return True
        try:  # a server on all addresses of this machine accepts no name: DNS could rebind it
            ipaddress.ip_address(name.strip('[]'))
            return ipaddress.ip_address(self._host).is_unspecified
        except ValueError:
            return False


def protect(answer: web.StreamResponse) -> None:
    """Add the headers that keep other pages out, and foreign content out of our page."""
    for name, value in HEADERS.items():
        answer.headers.setdefault(name, value)
    answer.headers.setdefault('Content-Security-Policy', POLICY)
    answer.headers.setdefault('Cache-Control', 'no-store')


def refusal(status: int, text: str) -> web.Response:
    """Return the answer to a refused request: one sentence."""
    return web.json_response({'error': safe_line(text)}, status=status)
