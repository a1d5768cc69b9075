//! What the page shows in headless Chromium. Without one in PATH these tests skip with a printed line.

use support::process::{Place, flag};

use super::browser::Page;
use super::server::{address, beside, end, place};

/// Until the picture of frame `n` is on the canvas, and nothing is drawn anew any more.
fn shows(page: &mut Page, n: u32) {
    page.wait_for("window.loomtree !== undefined");
    page.wait_for(&format!(
        "loomtree.shown.every((s) => s.frame && s.frame.number === {n}) && !loomtree.dirty && loomtree.scale === 1"
    ));
}

fn orange([r, g, b]: [u8; 3]) -> bool {
    r > 110 && r > b.saturating_add(40) && r > g.saturating_add(25)
}

fn blue([r, g, b]: [u8; 3]) -> bool {
    b > 90 && b > r.saturating_add(40) && g > r
}

#[test]
fn a_run_is_shown_and_scrubbed_and_colored() {
    let place = place();
    let mut view = place.start("view run");
    let Some(mut page) = Page::open(&address(&mut view)) else { return end(view) };
    shows(&mut page, 6);
    let last = page.canvas();
    // Cloth in its color covers a good part of the canvas, and the ground another part.
    assert!(last.share(orange) > 0.1, "{}", last.share(orange));
    assert!(last.share(|pixel| !orange(pixel)) > 0.2);

    page.value("loomtree.seek(0)");
    shows(&mut page, 0);
    let first = page.canvas();
    assert!(first.share(orange) > 0.1);
    assert!(first.differs(&last) > 0.005, "frames 0 and 6 look alike: {}", first.differs(&last));
    // The same frame is the same picture, once the camera has seen all of the run.
    let again = |page: &mut Page, n: u32| {
        page.value(&format!("loomtree.seek({n})"));
        shows(page, n);
        page.canvas()
    };
    let (last, first, same) = (again(&mut page, 6), again(&mut page, 0), again(&mut page, 6));
    assert!(same.differs(&last) < 0.001 && first.differs(&last) > 0.005, "{}", same.differs(&last));
    // A click in the middle of the bar goes to the middle of the run.
    page.value(
        "(() => { const c = document.getElementById('scrub'), b = c.getBoundingClientRect(); \
         c.setPointerCapture = () => {}; c.dispatchEvent(new PointerEvent('pointerdown', \
         { clientX: b.x + b.width / 2, clientY: b.y + b.height / 2, pointerId: 1, buttons: 1 })); })()",
    );
    shows(&mut page, 3);

    // Two ranks, two colors, about as much of each; without them the second one is not there.
    assert!(page.canvas().share(blue) < 0.01);
    page.value("document.querySelector('[data-mode=rank]').click()");
    page.wait_for("loomtree.runs[0].values.get('rank') instanceof Float32Array && !loomtree.dirty");
    let ranks = page.canvas();
    assert!(ranks.share(orange) > 0.03 && ranks.share(blue) > 0.03, "{} {}", ranks.share(orange), ranks.share(blue));
    assert_eq!(page.value("document.getElementById('legend').innerText.includes('rank 1')"), true);
    page.value("document.querySelector('[data-mode=strain]').click()");
    page.wait_for("loomtree.runs[0].values.get('strain/3') instanceof Float32Array && !loomtree.dirty");
    assert!(page.canvas().differs(&ranks) > 0.05);

    // Hidden cloth is not drawn.
    page.value("document.querySelector('[data-kind=piece]').click()");
    page.wait_for("!loomtree.dirty");
    assert!(page.canvas().differs(&ranks) > 0.1);

    // The timeline has a lane per worker, the curves a chart per figure.
    page.value("loomtree.seek(1)");
    page.wait_for("loomtree.dock.sheets.Timeline.data && loomtree.dock.sheets.Timeline.data.lanes.length === 2");
    page.value("loomtree.dock.open('Curves')");
    page.wait_for("document.querySelectorAll('.chart').length >= 4");
    page.value("loomtree.dock.open('Links and memory')");
    page.wait_for("document.querySelector('.heat') !== null");
    assert_eq!(page.complaints(), [""; 0]);
    drop(page);
    end(view);
}

#[test]
fn a_run_grows_while_it_is_shown_and_may_go_and_come_back() {
    let place = Place::new();
    place.write("flag.toml", flag(4096, 10, 60));
    let mut run = place.start("run flag.toml --executor cpu --workers 1 --threads 1 --out run --view");
    let Some(mut page) = Page::open(&address(&mut run)) else {
        run.wait_for_frame("run", 60);
        return end(run);
    };
    page.wait_for("window.loomtree !== undefined && loomtree.shown[0].frame !== null");
    let early = page.value("loomtree.runs[0].lastFrame").as_i64().unwrap();
    assert!(early < 60, "the run was over before it was looked at");
    // It follows the newest frame, and the bar grows.
    page.wait_for(&format!("loomtree.runs[0].lastFrame >= {}", early + 3));
    page.wait_for(&format!("loomtree.shown[0].frame.number > {early}"));
    run.wait_for_frame("run", 60);
    page.wait_for("loomtree.frame === 60 && loomtree.shown[0].frame.number === 60");
    page.wait_for("document.querySelector('.pill').textContent === 'done'");

    // Deleted: what was loaded stays. Made anew with other frames: the new ones are shown.
    std::fs::rename(place.path("run"), place.path("away")).unwrap();
    page.wait_for("document.querySelector('.pill').textContent === 'gone'");
    assert!(page.canvas().share(orange) > 0.05);
    let (code, _, stderr) = beside(&place, "run flag.toml --executor cpu --workers 1 --threads 1 --frames 2 --out run");
    assert_eq!(code, Some(0), "{stderr}");
    page.wait_for("loomtree.runs[0].wanted === 2 && loomtree.shown[0].frame?.number === 2");
    let complaints = page.complaints();
    assert_eq!(complaints, [""; 0]);
    drop(page);
    end(run);
}

#[test]
fn two_runs_are_shown_side_by_side_with_their_distance() {
    let place = place();
    place.write("other.toml", flag(512, 4, 6).replace("9.0", "30.0"));
    place.run("run other.toml --executor cpu --workers 2 --threads 1 --out other").expect(0);
    let mut view = place.start("view run other");
    let Some(mut page) = Page::open(&address(&mut view)) else { return end(view) };
    shows(&mut page, 6);
    let picture = page.canvas();
    assert!(picture.share(orange) > 0.08, "{}", picture.share(orange));
    page.wait_for("document.getElementById('distance') !== null");
    // The figures are those of `compare`.
    let shown = page.value("loomtree.distances.get(6)");
    let (code, stdout, stderr) = beside(&place, "compare run other --json");
    assert_eq!(code, Some(0), "{stderr}");
    let compared: serde_json::Value = serde_json::from_str(&stdout).unwrap();
    let frame = compared["frames"].as_array().unwrap().iter().find(|frame| frame["frame"] == 6).unwrap();
    for figure in ["rms_m", "max_m", "max_vertex", "aligned_rms_m", "eq17_theta", "eq17_curvature"] {
        assert_eq!(shown[figure], frame[figure], "{figure}");
    }
    assert!(shown["rms_m"].as_f64().unwrap() > 1e-6);
    assert_eq!(page.complaints(), [""; 0]);
    drop(page);
    end(view);
}

#[test]
fn a_live_run_is_steered_from_the_page() {
    let place = Place::new();
    place.write("flag.toml", flag(512, 4, 100_000).replace("edge = \"left\"", "name = \"pole\"\nedge = \"left\""));
    let mut run = place.start("run flag.toml --executor cpu --workers 2 --threads 1 --out run --live --view");
    let Some(mut page) = Page::open(&address(&mut run)) else { return end(run) };
    // The page of a live run begins with what steers it.
    page.wait_for("window.loomtree !== undefined && loomtree.shown[0].frame !== null");
    page.wait_for("loomtree.dock.now === 'Live' && loomtree.dock.sheets.Live.status !== null");
    let status = |page: &mut Page, what: &str| page.value(&format!("loomtree.dock.sheets.Live.status.{what}"));
    let click = |page: &mut Page, id: &str| drop(page.value(&format!("document.getElementById('live-{id}').click()")));
    click(&mut page, "pause");
    page.wait_for("loomtree.dock.sheets.Live.status.state === 'paused'");
    let step = status(&mut page, "step").as_u64().unwrap();
    std::thread::sleep(std::time::Duration::from_millis(300));
    click(&mut page, "step");
    page.wait_for(&format!("loomtree.dock.sheets.Live.status.step === {}", step + 1));
    // Up to the next frame, which the page then shows.
    click(&mut page, "frame");
    page.wait_for("loomtree.dock.sheets.Live.status.step % 4 === 0");
    page.wait_for("loomtree.shown[0].frame.number === loomtree.dock.sheets.Live.status.frame");
    page.keep_picture("live.png");
    let height = "(() => { const p = loomtree.shown[0].frame.positions; let sum = 0; \
                  for (let i = 1; i < p.length; i += 3) sum += p[i]; return sum / (p.length / 3); })()";
    let (frame, before) = (status(&mut page, "frame").as_u64().unwrap(), page.value(height).as_f64().unwrap());
    // Gravity the other way round, and no wind: the flag rises.
    for (name, values) in [("gravity", "['0', '30', '0']"), ("wind", "['0', '0', '0']")] {
        // As typed values do, they stay when the page is told those of the run.
        page.value(&format!(
            "{values}.forEach((value, i) => {{ const input = loomtree.dock.sheets.Live.vectors.{name}[i]; \
             input.value = value; input.onchange(); }})"
        ));
        click(&mut page, name);
    }
    page.wait_for("loomtree.dock.sheets.Live.status.gravity_m_s2[1] === 30");
    page.wait_for("loomtree.dock.sheets.Live.status.wind_m_s[0] === 0");
    let record = std::fs::read_to_string(place.path("run/run_changes.toml")).unwrap();
    assert!(record.contains("do = \"gravity\"") && record.contains("gravity_m_s2 = [0, 30, 0]"), "{record}");
    click(&mut page, "pause");
    page.wait_for(&format!("loomtree.shown[0].frame.number >= {}", frame + 25));
    let after = page.value(height).as_f64().unwrap();
    assert!(after > before + 0.05, "{before} {after}");
    // What is wrong is said, and the pin is a button that lets it go.
    page.value("loomtree.dock.sheets.Live.friction.value = '-1'");
    click(&mut page, "friction");
    page.wait_for("document.getElementById('live-said').textContent.includes('at least 0')");
    page.value("loomtree.dock.sheets.Live.pins.querySelector('button').click()");
    page.wait_for("loomtree.dock.sheets.Live.status.pins.length === 0");
    click(&mut page, "save");
    page.wait_for("document.getElementById('live-said').textContent.includes('saved.toml')");
    assert!(std::fs::read_to_string(place.path("run/saved.toml")).unwrap().contains("pin = \"pole\""));
    assert_eq!(page.complaints(), [""; 0]);
    drop(page);
    end(run);
}

#[test]
fn a_seam_is_sewn_by_clicks_and_the_sewn_mesh_is_shown() {
    let place = Place::new();
    place.write(
        "panels.toml",
        r#"
        name = "panels"
        [simulation]
        step_s = 0.004
        steps_per_frame = 2
        frames = 100000
        gravity_m_s2 = [0, 0, 0]
        thickness_m = 0.001
        [[cloth]]
        name = "one"
        sheet = { size_m = [0.2, 0.16], triangles = 120 }
        [[cloth]]
        name = "other"
        sheet = { size_m = [0.2, 0.16], triangles = 120 }
        origin_m = [0.3, 0, 0]
        "#,
    );
    let words = "run panels.toml --executor cpu --workers 2 --threads 1 --out run --live --paused --view";
    let mut run = place.start(words);
    let Some(mut page) = Page::open(&address(&mut run)) else { return end(run) };
    page.wait_for("window.loomtree !== undefined && loomtree.shown[0].frame !== null && !loomtree.dirty");
    page.wait_for("loomtree.dock.now === 'Live' && loomtree.dock.sheets.Live.status !== null");
    page.value("loomtree.dock.sheets.Live.closeS.value = '0.05'");
    page.value("document.getElementById('live-pick').click()");
    for (x, y) in [(0.2, 0.0), (0.2, 0.16), (0.3, 0.0), (0.3, 0.16)] {
        page.value(&format!(
            "(() => {{ const live = loomtree.dock.sheets.Live, canvas = document.getElementById('view'); \
             const p = loomtree.shown[0].frame.positions, box = canvas.getBoundingClientRect(); \
             const far = (v) => Math.hypot(p[3 * v] - {x}, p[3 * v + 1] - {y}, p[3 * v + 2]); \
             let best = 0; for (let v = 0; v < p.length / 3; v++) if (far(v) < far(best)) best = v; \
             const [sx, sy] = live.onScreen(p, best, box); \
             const at = {{ clientX: box.left + sx + 3, clientY: box.top + sy - 2, bubbles: true }}; \
             canvas.dispatchEvent(new MouseEvent('click', at)); }})()"
        ));
        if x == 0.3 && y == 0.0 {
            page.wait_for("document.querySelectorAll('#marks i').length === 3");
            page.keep_picture("live_seam.png");
        }
    }
    page.wait_for("loomtree.dock.sheets.Live.status.seams.length === 1");
    let vertices = page.value("loomtree.dock.sheets.Live.status.vertices").as_u64().unwrap();
    page.value("document.getElementById('live-pause').click()");
    // Welded: fewer vertices, and the picture has the new mesh.
    page.wait_for(&format!("loomtree.dock.sheets.Live.status.vertices < {vertices}"));
    page.wait_for("loomtree.shown[0].frame.mesh.vertices === loomtree.dock.sheets.Live.status.vertices");
    page.wait_for("loomtree.shown[0].layers.fine.mesh === loomtree.shown[0].frame.mesh");
    // A frame of before is shown with its own mesh.
    page.value("loomtree.seek(0)");
    page.wait_for(&format!(
        "loomtree.shown[0].frame.number === 0 && loomtree.shown[0].frame.mesh.vertices === {vertices}"
    ));
    page.keep_picture("live_sewn.png");
    assert_eq!(page.complaints(), [""; 0]);
    drop(page);
    end(run);
}
