// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** The computer's camera: a preview, and buttons that take a photograph or record a film. */

import {h, patch} from './dom.js';
import {button} from './parts.js';

const WISH = {video: {width: {ideal: 4000}, height: {ideal: 3000}, facingMode: 'environment'}, audio: false};
const RATE = 12e6; // bits of a film in a second
const REASONS = {
  NotAllowedError:
    'The browser does not allow this page to use the camera; allow it beside the address, then try again.',
  NotFoundError: 'This computer has no camera; connect one, or choose photographs from files.',
  NotReadableError: 'The camera is used by another program; end that, then try again.',
};
const NO_DEVICES =
  'The browser offers no camera to this page, since its address is not that of this computer; take the ' +
  'photographs with the telephone’s or computer’s own program, and choose their files.';

/**
 * Open the camera's dialogue.
 *
 * @param {(file: File) => void} take called with each photograph and film
 */
export async function openCamera(take) {
  const dialog = document.getElementById('camera');
  let stream = null;
  let count = 0;
  let text = 'The camera is being opened …';
  let failed = false;
  let recorder = null;
  const end = () => {
    recorder?.stop();
    stream?.getTracks().forEach((track) => track.stop());
  };
  const record = () => {
    if (recorder) return recorder.stop();
    const pieces = [];
    recorder = new MediaRecorder(stream, {videoBitsPerSecond: RATE});
    recorder.ondataavailable = ({data}) => pieces.push(data);
    recorder.onstop = () => {
      const kind = recorder.mimeType.includes('mp4') ? 'mp4' : 'webm';
      recorder = null;
      take(new File(pieces, `film ${new Date().toLocaleTimeString('en-GB').replace(/:/g, '.')}.${kind}`));
      if (dialog.open) dialog.close();
    };
    recorder.start();
    text = 'Recording: keep hands away for two seconds, move the DLO, take the hand away, and wait until it rests.';
    return draw();
  };
  const draw = () => {
    patch(dialog, [
      h('h2', {id: 'camera-title'}, 'Camera'),
      h('video', {muted: true, playsinline: true, autoplay: true}),
      h('p', {role: 'status', class: failed ? 'problem' : null}, text),
      h(
        'div.row',
        {},
        button('Take photograph', shoot, {class: 'primary', disabled: !stream || Boolean(recorder)}),
        window.MediaRecorder
          ? button(recorder ? 'Stop recording' : 'Record a film', record, {disabled: !stream})
          : null,
        button('Close', () => dialog.close()),
      ),
    ]);
  };
  const shoot = () => {
    const video = dialog.querySelector('video');
    const canvas = document.createElement('canvas');
    canvas.width = video.videoWidth;
    canvas.height = video.videoHeight;
    canvas.getContext('2d').drawImage(video, 0, 0);
    canvas.toBlob(
      (blob) => {
        if (!blob) return;
        count += 1;
        text = `Photograph ${count} is taken.`;
        take(new File([blob], `camera ${new Date().toLocaleTimeString('en-GB').replace(/:/g, '.')}.jpg`));
        draw();
      },
      'image/jpeg',
      0.95,
    );
  };
  dialog.onclose = end;
  draw();
  dialog.showModal();
  try {
    if (!navigator.mediaDevices) throw new Error(NO_DEVICES);
    stream = await navigator.mediaDevices.getUserMedia(WISH);
    if (!dialog.open) return end();
    dialog.querySelector('video').srcObject = stream;
    text = 'Hold the camera above the table, so that the whole DLO and the board are visible.';
  } catch (error) {
    failed = true;
    text =
      REASONS[error.name] ??
      (error.message === NO_DEVICES ? NO_DEVICES : `The camera cannot be used: ${error.message}`);
  }
  draw();
  return null;
}
