//! The page in a real browser, on a real camera: `web/tests/newcomer.spec.ts`.

use super::playwright;
use super::support::*;

#[test]
fn somebody_new_adds_a_camera_and_counts() {
    let Some(clip) = clip() else { return };
    if !playwright::ready() {
        return;
    }
    let camera = CameraProcess::start(&clip, &[]);
    let nobody = Refusing::start();
    let state = tempfile::tempdir().unwrap();
    let service = Service::start(state.path(), &[]);
    let wrong = format!("rtsp://{}/live", nobody.address());
    let settings = [("GAKP_CAMERA", camera.url.as_str()), ("GAKP_WRONG", wrong.as_str())];
    playwright::run("newcomer", &format!("http://{}", service.address), &settings);
    service.stop();
}
