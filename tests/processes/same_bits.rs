//! The same bits from real worker processes, whatever their number and schedule, and from run to run.

use support::process::{Place, flag, repository};

const FRAMES: usize = 20;

/// Runs the flag of this test with `flags` and returns frames and hashes.
fn hashes(place: &Place, out: &str, flags: &str) -> Vec<(u64, String)> {
    let ended = place.run(&format!("run flag.toml --executor cpu --out {out} {flags}")).expect(0);
    assert_eq!(place.report(out)["status"], "done", "{}", ended.story);
    place.hashes(out)
}

fn flag_place() -> (Place, Vec<(u64, String)>) {
    let place = Place::new();
    place.write("flag.toml", flag(1500, 3, FRAMES as u32));
    let one = hashes(&place, "one", "--workers 1");
    assert_eq!(one.len(), FRAMES + 1);
    assert!(one.windows(2).all(|pair| pair[1].0 == pair[0].0 + 1 && pair[1].1 != pair[0].1), "the flag moves: {one:?}");
    (place, one)
}

#[test]
fn two_three_four_and_eight_workers_give_the_bits_of_one() {
    let (place, one) = flag_place();
    for workers in [2, 3, 4, 8] {
        assert_eq!(
            hashes(&place, &format!("many{workers}"), &format!("--workers {workers}")),
            one,
            "{workers} workers"
        );
    }
    assert_eq!(hashes(&place, "again", "--workers 4"), one, "4 workers once more");
}

#[test]
fn schedules_topologies_and_threads_change_no_bit() {
    let (place, one) = flag_place();
    for schedule in ["fat-tree", "ring", "direct", "best"] {
        assert_eq!(hashes(&place, schedule, &format!("--workers 4 --schedule {schedule}")), one, "{schedule}");
        assert_eq!(place.report(schedule)["schedule"], schedule);
    }
    let topology = repository("topology/pcie_4.toml");
    assert_eq!(hashes(&place, "pcie", &format!("--workers 4 --topology {}", topology.display())), one, "pcie_4");
    assert_eq!(hashes(&place, "threads", "--workers 2 --threads 3"), one, "3 threads each");
}

#[test]
fn jacobi_gives_the_bits_of_one_worker_on_any_number() {
    let (place, schwarz) = flag_place();
    assert_eq!(place.report("one")["preconditioner"], "schwarz");
    let run = |workers: usize| {
        let out = format!("jacobi{workers}");
        let hashes = hashes(&place, &out, &format!("--workers {workers} --preconditioner jacobi"));
        assert_eq!(place.report(&out)["preconditioner"], "jacobi");
        hashes
    };
    let one = run(1);
    assert!(one.last() != schwarz.last(), "another preconditioner, other bits");
    for workers in [2, 3, 8] {
        assert_eq!(run(workers), one, "{workers} workers");
    }
    let iterations = |out: &str| total(&place.report(out), "iterations");
    assert!(iterations("one") < iterations("jacobi1"), "{} of {}", iterations("one"), iterations("jacobi1"));
}

/// The shipped scene, small, with the ball close to the cloths.
fn sphere_place() -> Place {
    let place = Place::new();
    let scene = std::fs::read_to_string(repository("scenes/sphere.toml")).expect("the shipped scene");
    let (at, size) = ("center_m = [0.05, 1.0, 0.45]", "triangles = 5_000");
    assert!(scene.contains(at) && scene.contains(size), "the scene has changed");
    place.write("sphere.toml", scene.replace(at, "center_m = [0.05, 1.0, 0.28]").replace(size, "triangles = 1_000"));
    place
}

/// Sum over the steps of a number in a report.
fn total(report: &serde_json::Value, field: &str) -> f64 {
    let steps = report["steps"].as_array().expect("steps in the report");
    steps.iter().map(|step| step[field].as_f64().unwrap_or_else(|| panic!("no {field} in {step}"))).sum()
}

#[test]
fn contacts_and_zones_give_the_same_bits_and_can_be_resumed_in_their_midst() {
    const RUN: &str = "run sphere.toml --executor cpu --resolution 2000";
    let place = sphere_place();
    let run = |out: &str, flags: &str| {
        let ended = place.run(&format!("{RUN} --out {out} {flags}")).expect(0);
        assert_eq!(place.report(out)["status"], "done", "{}", ended.story);
        place.hashes(out)
    };
    let one = run("one", "--workers 1 --frames 8");
    assert_eq!(one.len(), 9);
    let report = place.report("one");
    for field in ["contacts", "zones", "zone_rounds", "impacts", "zone_iterations"] {
        assert!(total(&report, field) > 0.0, "{field}");
    }
    let last = report["steps"].as_array().expect("steps").last().expect("a step").clone();
    assert!(last["contacts"].as_u64() > Some(10) && last["smallest_gap_m"].as_f64() > Some(0.0), "{last}");
    for workers in [2, 3, 4, 8] {
        let out = format!("many{workers}");
        assert_eq!(run(&out, &format!("--workers {workers} --frames 8")), one, "{workers} workers");
        for field in ["contacts", "zones", "impacts"] {
            assert_eq!(total(&place.report(&out), field), total(&report, field), "{field} of {workers} workers");
        }
    }
    // Stopped where contacts act, taken up by fewer.
    run("resumed", "--workers 4 --frames 6");
    place.run("run --resume --out resumed --workers 2 --frames 8").expect(0);
    assert_eq!(place.report("resumed")["resumed"][0]["frame"], 6);
    assert_eq!(place.hashes("resumed"), one, "resumed");
}

#[test]
fn full_exchange_repeats_its_bits() {
    let place = Place::new();
    place.write("flag.toml", flag(1000, 2, FRAMES as u32));
    for workers in [3, 4] {
        let run =
            |out: &str| hashes(&place, &format!("{out}{workers}"), &format!("--workers {workers} --exchange full"));
        let first = run("first");
        assert_eq!(first.len(), FRAMES + 1);
        assert_eq!(run("second"), first, "{workers} workers");
    }
}

#[test]
fn workers_with_a_device_each_give_the_bits_of_one() {
    // Prints why and stops here where there is no adapter.
    if support::device::executor().is_none() {
        return;
    }
    let place = Place::new();
    place.write("flag.toml", flag(400, 1, 2));
    let run = |workers: usize| {
        let out = format!("gpu{workers}");
        place.run(&format!("run flag.toml --executor gpu --heartbeat 60 --out {out} --workers {workers}")).expect(0);
        assert_eq!(place.report(&out)["executor"], "gpu");
        place.hashes(&out)
    };
    let one = run(1);
    assert_eq!(one.len(), 3);
    for workers in [2, 4] {
        assert_eq!(run(workers), one, "{workers} workers");
    }
}

/// Values over time, force fields and a ball under pressure that falls on the sheet.
#[test]
fn values_over_time_forces_and_pressure_have_the_bits_of_one_worker_and_of_a_resumed_run() {
    let place = Place::new();
    let ball = loomtree::mesh::shapes::sphere(0.15, 4);
    let vertices = ball.positions.iter().map(|x| format!("v {} {} {}\n", x.x, x.y + 0.2, x.z));
    let faces = ball.triangles.iter().map(|t| format!("f {} {} {}\n", t[0] + 1, t[1] + 1, t[2] + 1));
    place.write("ball.obj", vertices.chain(faces).collect::<String>());
    place.write(
        "scene.toml",
        r#"
        name = "over time"
        [simulation]
        frames = 6
        steps_per_frame = 8
        friction_factor = [{ time_s = 0, value = 1 }, { time_s = 0.15, value = 0.2 }]
        stiffness_factor = [{ time_s = 0.05, value = 1 }, { time_s = 0.1, value = 2.5 }]
        gravity_m_s2 = [{ time_s = 0, value = [0, -9.81, 0] }, { time_s = 0.2, value = [3, -6, 0] }]
        [air]
        wind_m_s = [{ time_s = 0, value = [0, 0, 0] }, { time_s = 0.1, value = [6, 0, 2] }]
        [[cloth]]
        sheet = { size_m = [0.8, 0.8], triangles = 500 }
        plane = "xz"
        origin_m = [-0.4, 0, -0.4]
        [[cloth]]
        mesh = "ball.obj"
        pressure_pa = 60
        [[pin]]
        cloth = 0
        corners = ["top-left", "bottom-right"]
        [[force]]
        kind = "turbulence"
        strength_m_s2 = 8
        scale_m = 0.2
        change_s = 0.1
        [[force]]
        kind = "vortex"
        strength_m_s2 = 5
        radius_m = 0.6
        "#,
    );
    let run = |out: &str, flags: &str| {
        place.run(&format!("run scene.toml --executor cpu --out {out} {flags}")).expect(0);
        place.hashes(out)
    };
    let one = run("one", "--workers 1");
    assert_eq!(one.len(), 7);
    for workers in [2, 3, 5] {
        assert_eq!(run(&format!("many{workers}"), &format!("--workers {workers}")), one, "{workers} workers");
    }
    run("half", "--workers 2 --frames 3");
    place.run("run --resume --out half --frames 6 --workers 3").expect(0);
    assert_eq!(place.hashes("half"), one, "resumed");
}
