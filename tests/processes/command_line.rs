//! The command line as a whole: help, completions, a scene to start from, how much is said, fields set from outside,
//! the report of a run as one file.

use support::process::{Place, flag};

#[test]
fn help_is_at_most_100_columns_wide() {
    let place = Place::new();
    let help = place.run("--help").expect(0).stdout;
    let listed = help.lines().skip_while(|line| *line != "Commands:").skip(1).take_while(|line| !line.is_empty());
    let commands: Vec<String> = listed
        .filter(|line| line.starts_with("  ") && !line.starts_with("   "))
        .filter_map(|line| line.split_whitespace().next().map(str::to_string))
        .collect();
    assert!(commands.len() > 12, "{commands:?}");
    for command in commands.iter().filter(|command| *command != "help") {
        let help = place.run(&format!("{command} --help")).expect(0).stdout;
        let widest = help.lines().max_by_key(|line| line.chars().count()).unwrap();
        assert!(widest.chars().count() <= 100, "{command}: {} columns: {widest}", widest.chars().count());
    }
}

#[test]
fn shells_can_complete_every_command() {
    let place = Place::new();
    for shell in ["bash", "zsh", "fish"] {
        let script = place.run(&format!("completions {shell}")).expect(0).stdout;
        for word in ["view", "segments", "resolution", "report"] {
            assert!(script.contains(word), "{shell} knows no {word}");
        }
    }
    let ended = place.run("completions tcsh").expect(2);
    assert!(ended.stderr.contains("tcsh"), "{}", ended.story);
}

#[test]
fn there_is_a_manual_page_of_every_command() {
    let place = Place::new();
    place.run("man pages").expect(0);
    let page = |name: &str| std::fs::read_to_string(place.path("pages").join(name)).expect("a page");
    assert!(page("loomtree.1").contains("loomtree\\-run"), "{}", page("loomtree.1"));
    assert!(page("loomtree-run.1").contains("\\-\\-workers") && page("loomtree-bench-step.1").contains("rounds"));
    place.write("file", "");
    let ended = place.run("man file").expect(2);
    assert!(ended.error().contains("file: "), "{}", ended.story);
}

#[test]
fn frames_per_second_are_set_from_outside() {
    let place = Place::new();
    place.write("flag.toml", flag(256, 5, 10));
    place.run("run flag.toml --fps 30 --frames 2 --out out").expect(0);
    let report = place.report("out");
    let frame_s = report["step_s"].as_f64().unwrap() * report["steps_per_frame"].as_f64().unwrap();
    assert!((frame_s * 30.0 - 1.0).abs() < 1e-9, "{frame_s}");
    // A run that goes on has the frames of before.
    place.run("run --resume --out out --frames 3").expect(0);
    assert_eq!(place.report("out")["step_s"], report["step_s"]);
    let ended = place.run("run flag.toml --fps 0 --out other").expect(2);
    assert!(ended.stderr.contains("frames per second"), "{}", ended.story);
}

#[test]
fn a_scene_to_start_from_is_valid_and_is_not_overwritten() {
    let place = Place::new();
    place.run("init a.toml").expect(0);
    let ended = place.run("check a.toml").expect(0);
    assert!(!ended.stderr.contains("warning"), "{}", ended.story);
    let ended = place.run("init a.toml").expect(2);
    assert!(ended.error().contains("a.toml is there already; --overwrite replaces it"), "{}", ended.story);
    place.run("init a.toml --overwrite").expect(0);
    let ended = place.run("init a.txt").expect(2);
    assert!(ended.error().contains("ends in .toml"), "{}", ended.story);
    let schema: serde_json::Value = serde_json::from_str(&place.run("schema").expect(0).stdout).unwrap();
    assert!(schema["properties"]["simulation"]["properties"]["friction"].is_object());
    place.run("schema --out s.json").expect(0);
    assert_eq!(
        serde_json::from_slice::<serde_json::Value>(&std::fs::read(place.path("s.json")).unwrap()).unwrap(),
        schema
    );
}

#[test]
fn quiet_says_nothing_and_verbose_says_every_step() {
    let place = Place::new();
    place.write("flag.toml", flag(256, 3, 2));
    let run = |more: &str, out: &str| {
        place.run(&format!("run flag.toml --executor cpu --workers 1 --threads 1 --out {out} {more}")).expect(0).stderr
    };
    assert_eq!(run("-q", "a"), "");
    let usual = run("", "b");
    assert!(usual.contains("frame 2/2") && !usual.contains("step 4: "), "{usual}");
    let verbose = run("-v", "c");
    for step in 1..=6 {
        assert!(verbose.contains(&format!("step {step}: ")), "{step}: {verbose}");
    }
    assert_eq!(place.hashes("a"), place.hashes("c"));
    let ended = place.run("-q run nowhere.toml").expect(2);
    assert!(ended.error().contains("nowhere.toml"), "{}", ended.story);
}

#[test]
fn fields_of_a_scene_are_set_on_the_command_line() {
    let place = Place::new();
    place.write("flag.toml", flag(256, 3, 4));
    place.write("heavy.toml", flag(256, 3, 4).replace("step_s = 0.004", "step_s = 0.004\ngravity_m_s2 = [0, -3, 0]"));
    let of = "--executor cpu --workers 1 --threads 1";
    place.run(&format!("run heavy.toml {of} --out expected")).expect(0);
    place.run(&format!("run flag.toml {of} --out plain")).expect(0);
    let set = "--set simulation.gravity_m_s2=[0,-3,0]";
    place.run(&format!("run flag.toml {of} {set} --frames 2 --out set")).expect(0);
    // A run that goes on keeps what was set.
    place.run("run --resume --out set --frames 4").expect(0);
    assert_eq!(place.hashes("set"), place.hashes("expected"));
    assert_ne!(place.hashes("set"), place.hashes("plain"));
    for (words, sentence) in [
        (format!("run flag.toml {of} --set simulation.frictoin=1 --out x"), "frictoin"),
        (format!("run flag.toml {of} --set friction --out x"), "write FIELD=VALUE"),
        (format!("run flag.toml {of} --set cloth.shirt.friction=1 --out x"), "there is no `shirt`"),
        ("run --resume --out set --set simulation.friction=1".to_string(), "cannot go with --resume"),
    ] {
        let ended = place.run(&words).expect(2);
        assert!(ended.error().contains(sentence), "{}", ended.story);
    }
}

#[test]
fn a_report_is_one_file_with_pictures_curves_and_a_timeline() {
    let place = Place::new();
    place.write("flag.toml", flag(256, 3, 4));
    place.run("run flag.toml --executor cpu --workers 2 --threads 1 --out run").expect(0);
    place.run("report run --executor cpu --pictures 3").expect(0);
    let html = std::fs::read_to_string(place.path("run/report.html")).unwrap();
    assert_eq!(html.matches("data:image/png;base64,iVBOR").count(), 3);
    for part in
        ["frame 0", "frame 2", "frame 4", "Iterations of a step", "Time of a step", "rank 1", "What the workers did"]
    {
        assert!(html.contains(part), "{part}");
    }
    for outside in ["<script", "src=\"http", "<link", "@import"] {
        assert!(!html.contains(outside), "{outside}");
    }
    // Without frames or a trace there is still a report; without a run there is none.
    std::fs::remove_dir_all(place.path("run/frames")).unwrap();
    std::fs::remove_file(place.path("run/trace.json")).unwrap();
    place.run("report run --out other.html").expect(0);
    assert!(!std::fs::read_to_string(place.path("other.html")).unwrap().contains("data:image"));
    let ended = place.run("report nowhere").expect(2);
    assert!(ended.error().contains("nowhere is not a run directory"), "{}", ended.story);
}

#[test]
fn progress_in_a_file_says_how_long_it_took_and_takes() {
    let place = Place::new();
    place.write("flag.toml", flag(256, 3, 3));
    let of = "run flag.toml --executor cpu --workers 1 --threads 1";
    let said = place.run(&format!("{of} --resolution 0.3K --out a")).expect(0).stderr;
    let line = |frame: &str| said.lines().find(|line| line.starts_with(frame)).unwrap_or_else(|| panic!("{said}"));
    assert!(line("frame 1/3").contains(" s so far, ") && line("frame 1/3").contains(" s left, state "), "{said}");
    assert!(line("frame 3/3").contains(" s so far, state ") && !line("frame 3/3").contains("left"), "{said}");
    assert_eq!(place.report("a")["triangles"], 320);
    // The log knows the plan, the ranks and what is written; at its finest every stage of every step.
    let said = place.run(&format!("{of} --out b -v")).expect(0).stderr;
    for part in ["plan: ", "rank 0: cpu on ", "frame 2 written in", "checkpoint/step_00000009.ltc in"] {
        assert!(said.contains(part), "{part}: {said}");
    }
    assert!(!said.contains("slowest rank by stage"), "{said}");
    let program = support::process::program("loomtree");
    let trace = [("LOOMTREE_LOG", "loomtree=trace")];
    let said = place.start_program(&program, &format!("{of} --out c"), &trace).wait().expect(0).stderr;
    assert!(said.contains("step 4: slowest rank by stage") && said.contains("step 4, rank 0: "), "{said}");
}

const SHIRT: &str = "v 0 0 1.4\nv 0.5 0 1.4\nv 0.5 0 0\nv 0 0 0\nv 0.25 0.2 0.7\nf 1 2 5\nf 2 3 5\nf 3 4 5\nf 4 1 5\n";

/// A box from the ground up, `size` wide and twice as high along z, as triangles.
fn pillar(size: f64, from: f64) -> String {
    let mut text = String::new();
    for i in 0..8 {
        let at = |bit: u32, length: f64| if i >> bit & 1 == 1 { length } else { 0.0 };
        text += &format!("v {} {} {}\n", from + at(0, size), at(1, size), at(2, 3.0 * size));
    }
    for [a, b, c, d] in [[1, 3, 4, 2], [5, 6, 8, 7], [1, 2, 6, 5], [3, 7, 8, 4], [1, 5, 7, 3], [2, 4, 8, 6]] {
        text += &format!("f {a} {b} {c} {d}\n");
    }
    text
}

#[test]
fn a_scene_from_meshes_runs_as_it_is() {
    let place = Place::new();
    let scaled = |text: &str, factor: f64| -> String {
        let word = |word: &str| word.parse::<f64>().map_or(word.to_string(), |value| (value * factor).to_string());
        let line = |line: &str| match line.strip_prefix("v ") {
            Some(rest) => format!("v {}\n", rest.split(' ').map(word).collect::<Vec<_>>().join(" ")),
            None => format!("{line}\n"),
        };
        text.lines().map(line).collect()
    };
    // Centimeters, z up, beside a pillar on the ground.
    place.write("shirt.obj", scaled(SHIRT, 100.0));
    place.write("pillar.obj", pillar(60.0, 80.0));
    let ended = place.run("new-scene shirt.obj --obstacle pillar.obj --ground --fabric silk").expect(0);
    assert!(ended.stderr.contains("unit: centimeters, because everything together is"), "{}", ended.story);
    assert!(ended.stderr.contains("up: z, because what the cloth meets is tallest along z"), "{}", ended.story);
    assert!(ended.stdout.contains("shirt.toml; next: loomtree run shirt.toml --view"), "{}", ended.story);
    place.run("check shirt.toml").expect(0);
    place.run("run shirt.toml --executor cpu --workers 1 --threads 1 --frames 2 --out out").expect(0);
    let source = |out: &str| {
        let directory = loomtree::output::RunDirectory::open(&place.path(out)).unwrap();
        loomtree::output::FrameSource::open(&directory).unwrap()
    };
    let start = source("out").read(0).unwrap().positions;
    let high = start.iter().map(|p| p.y).fold(f32::MIN, f32::max);
    assert!((high - 1.4).abs() < 1e-4, "{high}");
    // In meters and alone, the cloth hangs by two of its vertices; a second one of the name gets another.
    std::fs::create_dir(place.path("more")).unwrap();
    place.write("more/shirt.obj", scaled(SHIRT, 1.0).replace("v 0", "v 3"));
    place.write("shirt.obj", SHIRT);
    let ended = place.run("new-scene shirt.obj more/shirt.obj --out two.toml --up z").expect(0);
    assert!(ended.stderr.contains("unit: meters"), "{}", ended.story);
    let text = std::fs::read_to_string(place.path("two.toml")).unwrap();
    assert!(text.contains("name = \"shirt 2\"") && text.contains("mesh = \"more/shirt.obj\""), "{text}");
    assert!(text.contains("vertices = [0, 1]"), "{text}");
    place.run("run two.toml --executor cpu --workers 1 --threads 1 --frames 5 --out two").expect(0);
    let (first, last) = (source("two").read(0).unwrap().positions, source("two").read(5).unwrap().positions);
    assert!(first[0] == last[0] && first[1] == last[1] && first[4] != last[4]);
    for (words, sentence) in [
        ("new-scene shirt.obj --out two.toml", "two.toml is there already; --overwrite replaces it"),
        ("new-scene shirt.obj --out two.txt", "ends in .toml"),
        ("new-scene none.obj --out x.toml", "none.obj: cannot be read"),
        ("new-scene shirt.obj --fabric plaid --out x.toml", "plaid"),
    ] {
        let ended = place.run(words).expect(2);
        assert!(ended.error().contains(sentence), "{}", ended.story);
    }
    assert!(!place.path("x.toml").exists());
}
