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
