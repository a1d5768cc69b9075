//! `loomtree render` on real runs: parts by name, colors that need the scene, cameras, movies, several runs in a
//! picture.

use std::fs::{self, File};
use std::io::BufReader;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use support::process::Place;

const SCENE: &str = r#"
[simulation]
steps_per_frame = 5
frames = 2
[[cloth]]
name = "left"
sheet = { size_m = [0.4, 0.4], triangles = 128 }
plane = "xz"
origin_m = [-0.5, 0.3, 0.2]
[[cloth]]
name = "right"
sheet = { size_m = [0.4, 0.4], triangles = 128 }
plane = "xz"
origin_m = [0.1, 0.3, 0.2]
[[obstacle]]
name = "ball"
sphere = { center_m = [-0.3, 0.1, 0], radius_m = 0.15, triangles = 320 }
"#;

struct Picture {
    width: usize,
    height: usize,
    rgb: Vec<u8>,
}

impl Picture {
    fn load(path: &Path) -> Picture {
        let mut reader = png::Decoder::new(BufReader::new(File::open(path).unwrap())).read_info().unwrap();
        let mut rgb = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut rgb).unwrap();
        Picture { width: info.width as usize, height: info.height as usize, rgb }
    }

    /// Pixels that a rule holds for, over all pixels.
    fn share(&self, rule: impl Fn(i32, i32, i32) -> bool) -> f64 {
        let pixels = self.rgb.chunks_exact(3).map(|p| [p[0], p[1], p[2]].map(i32::from));
        pixels.filter(|[r, g, b]| rule(*r, *g, *b)).count() as f64 / (self.width * self.height) as f64
    }
}

fn orange(r: i32, g: i32, b: i32) -> bool {
    r > g + 40 && g > b
}

fn blue(r: i32, g: i32, b: i32) -> bool {
    b > r + 60 && g > r + 30
}

fn place() -> Place {
    let place = Place::new();
    place.write("scene.toml", SCENE);
    place.run("run scene.toml --executor cpu --workers 2 --threads 1 --out run").expect(0);
    place
}

fn draw(place: &Place, flags: &str) -> Picture {
    let words = format!("render run --executor cpu --size 200x150 --frames 2..2 --out picture.png {flags}");
    place.run(&words).expect(0);
    Picture::load(&place.path("picture.png"))
}

#[test]
fn parts_are_hidden_and_looked_at_by_name() {
    let place = place();
    let whole = draw(&place, "");
    assert!(whole.share(orange) > 0.02 && whole.share(blue) > 0.02, "{} {}", whole.share(orange), whole.share(blue));
    // The right piece alone is one piece, which fills more of the picture; hiding it leaves no blue.
    let left = draw(&place, "--hide right --color piece");
    assert!(left.share(blue) < 0.001 && left.share(orange) > whole.share(orange));
    let near = draw(&place, "--target left");
    assert!(near.share(orange) > 1.5 * whole.share(orange), "{} {}", near.share(orange), whole.share(orange));
    let ball = draw(&place, "--target ball --hide left --hide right");
    assert!(ball.share(orange) + ball.share(blue) < 0.001);
    assert!(ball.rgb != draw(&place, "--target ball --hide left --hide right --hide ball").rgb);
    // A zoom by two makes four times the area; a point in the middle of the right piece puts it there.
    let zoomed = draw(&place, "--target 0.3,0.3,0 --zoom 2 --hide left --color fabric");
    let plain = draw(&place, "--target 0.3,0.3,0 --hide left --color fabric");
    let grown = zoomed.share(orange) / plain.share(orange);
    assert!((3.0..5.0).contains(&grown), "{grown}");
    // A long lens from far away shows about the same, but not the same.
    let long = draw(&place, "--lens 200");
    assert!((0.5..2.0).contains(&(long.share(orange) / whole.share(orange))) && long.rgb != whole.rgb);
    for (flags, sentence) in [
        ("--hide sleeve", "--hide sleeve: run has no part of this name; its pieces: left, right; its obstacles: ball"),
        ("--target sleeve", "--target sleeve: run has no part of this name"),
        ("--target 1,2", "--target 1,2: a point is X,Y,Z in meters"),
        ("--movie film.gif", "film.gif: the name of a movie ends in .mp4"),
        ("--out one.png", "--out one.png is one picture, but 3 frames are chosen"),
        ("--camera none.toml", "none.toml: "),
        ("--camera scene.toml", "scene.toml: line "),
    ] {
        let ended = place.run(&format!("render run --executor cpu --size 64x48 {flags}")).expect(2);
        assert!(ended.error().contains(sentence), "{}", ended.story);
    }
}

/// A sheet 0.85 m from corner to corner over a ball, which is 1.6 times as large with a radius of 0.4 m.
#[test]
fn an_obstacle_within_the_cloth_is_shown_whole_unless_it_is_much_larger() {
    let place = Place::new();
    let shots = [(0.4, "--target all"), (1.0, "--target cloth")].map(|(radius_m, same)| {
        let middle_m = -0.1 - radius_m;
        let scene = format!(
            "[simulation]\nsteps_per_frame = 5\nframes = 2\n\
             [[cloth]]\nsheet = {{ size_m = [0.6, 0.6], triangles = 128 }}\n\
             plane = \"xz\"\norigin_m = [-0.3, 0, 0.3]\n\
             [[obstacle]]\nsphere = {{ center_m = [0, {middle_m}, 0], radius_m = {radius_m} }}\n"
        );
        place.write("scene.toml", &scene);
        place.run("run scene.toml --executor cpu --out run --overwrite").expect(0);
        let shown = draw(&place, "");
        assert!(shown.rgb == draw(&place, same).rgb, "a ball of radius {radius_m} m");
        assert!(shown.share(orange) > 0.02);
        shown.share(orange) / draw(&place, "--target cloth").share(orange)
    });
    assert!(shots[0] < 0.8 && shots[1] == 1.0, "{shots:?}");
}

#[test]
fn colors_that_need_the_scene_are_those_of_the_page() {
    let place = place();
    // Two ranks: each has one of the pieces, give or take a few vertices.
    let ranks = draw(&place, "--color rank");
    assert!(ranks.share(orange) > 0.02 && ranks.share(blue) > 0.02);
    // The left piece lies on the ball and nothing touches the right one.
    place.run("run scene.toml --executor cpu --workers 1 --threads 1 --frames 10 --out run --overwrite").expect(0);
    let yellow = |r: i32, _: i32, b: i32| r > b + 50;
    let contacts = |hidden: &str| {
        let flags = format!("--executor cpu --size 200x150 --frames 10 --out p.png --color contact --hide {hidden}");
        place.run(&format!("render run {flags}")).expect(0);
        Picture::load(&place.path("p.png")).share(yellow)
    };
    assert!(contacts("right") > 0.02 && contacts("left") < 1e-3, "{} {}", contacts("right"), contacts("left"));
    // A wide picture has a legend in its corner, from blue to red.
    place.run("render run --executor cpu --size 480x360 --frames 10 --out p.png --color strain").expect(0);
    let strain = Picture::load(&place.path("p.png"));
    let row = &strain.rgb[3 * 480 * (360 - 8 - 9 - 6 + 3)..];
    let at = |x: usize| [row[3 * x], row[3 * x + 1], row[3 * x + 2]].map(i32::from);
    assert!(at(9)[2] > at(9)[0] + 60 && at(126)[0] > at(126)[2] + 60, "{:?} {:?}", at(9), at(126));
    // Without the recorded scene there is one sentence.
    fs::write(place.path("run/run_scene.toml"), "[[cloth").unwrap();
    let ended = place.run("render run --color rank").expect(2);
    assert!(ended.error().contains("the recorded scene is needed for that"), "{}", ended.story);
    draw(&place, "--color height");
}

#[test]
fn cameras_are_written_edited_and_moved() {
    let place = place();
    let first = draw(&place, "--save-camera camera.toml --azimuth 20 --elevation 40");
    let text = fs::read_to_string(place.path("camera.toml")).unwrap();
    assert!(text.contains("[[key]]") && text.contains("eye = [") && text.contains("lens_mm"), "{text}");
    let again = draw(&place, "--camera camera.toml");
    let differ = first.rgb.iter().zip(&again.rgb).filter(|(a, b)| a.abs_diff(**b) > 8).count();
    // The file holds a tenth of a millimeter.
    assert!(differ * 50 < first.rgb.len(), "{differ} of {}", first.rgb.len());
    let upside_down = text.replace("[[key]]", "[[key]]\nup = [0, -1, 0]");
    place.write("turned.toml", upside_down);
    assert!(draw(&place, "--camera turned.toml").rgb != again.rgb);
    // Two keys: in the middle frame the camera is between them.
    let key = |frame: u32, x: f64| format!("[[key]]\nframe = {frame}\neye = [{x}, 0.5, 3]\ntarget = [{x}, 0.2, 0]\n");
    place.write("moving.toml", key(0, -1.0) + &key(2, 1.0));
    place.write("still.toml", key(0, 0.0));
    let at = |camera: &str, frame: u32| {
        let of = format!("--executor cpu --size 200x150 --frames {frame} --out p.png --camera {camera}");
        place.run(&format!("render run {of}")).expect(0);
        Picture::load(&place.path("p.png")).rgb
    };
    // The light stays where the first key has put it, so only the cloth's place can be compared.
    assert!(at("moving.toml", 0) != at("moving.toml", 2) && at("moving.toml", 1) != at("still.toml", 2));
    let ended = place.run("render run --camera camera.toml --azimuth 3").expect(2);
    assert!(ended.stderr.contains("cannot be used with"), "{}", ended.story);
}

#[test]
fn a_movie_is_what_can_be_made_and_says_so() {
    let place = place();
    let of = "render run --executor cpu --size 64x48";
    // Without ffmpeg an animated PNG takes the place of the mp4.
    fs::create_dir(place.path("bare")).unwrap();
    std::os::unix::fs::symlink("/usr/bin/env", place.path("bare/env")).unwrap();
    let bare = place.path("bare").display().to_string();
    let bare = [("PATH", &bare[..])];
    let program = support::process::program("loomtree");
    let ended = place.start_program(&program, &format!("{of} --movie film.mp4"), &bare).wait().expect(0);
    assert!(ended.stderr.contains("there is no ffmpeg in PATH, so film.png is an animated PNG"), "{}", ended.story);
    assert!(ended.stdout.contains("movie in film.png"), "{}", ended.story);
    let file = BufReader::new(File::open(place.path("film.png")).unwrap());
    let reader = png::Decoder::new(file).read_info().unwrap();
    let control = reader.info().animation_control().expect("an animated PNG");
    assert_eq!(control.num_frames, 3);
    assert!(!place.path("film.mp4").exists() && !place.path(".film.png.part").exists());
    // A program of that name gets all pixels of all frames, and its complaint is the error.
    let fake = |script: &str| {
        fs::create_dir_all(place.path("bin")).unwrap();
        place.write("bin/ffmpeg", format!("#!/bin/sh\n{script}\n"));
        fs::set_permissions(place.path("bin/ffmpeg"), fs::Permissions::from_mode(0o755)).unwrap();
        let path = format!("{}:/usr/bin:/bin", place.path("bin").display());
        place.start_program(&program, &format!("{of} --fps 12 --movie film.mp4"), &[("PATH", &path)]).wait()
    };
    let counting = "echo \"$@\" > arguments; for last; do :; done; wc -c > \"$last\"";
    let ended = fake(counting).expect(0);
    assert!(ended.stdout.contains("movie in film.mp4"), "{}", ended.story);
    let bytes = fs::read_to_string(place.path("film.mp4")).unwrap();
    assert_eq!(bytes.trim(), (3 * 64 * 48 * 3).to_string());
    let arguments = fs::read_to_string(place.path("arguments")).unwrap();
    assert!(arguments.contains("-s 64x48 -r 12") && arguments.contains("-f mp4"), "{arguments}");
    fs::remove_file(place.path("film.mp4")).unwrap();
    let ended = fake("cat > /dev/null; echo no such codec >&2; exit 1").expect(1);
    assert!(ended.error().contains("film.mp4: ffmpeg: no such codec"), "{}", ended.story);
    assert!(!place.path("film.mp4").exists() && !place.path(".film.mp4.part").exists());
}

#[test]
fn several_runs_are_drawn_side_by_side_with_one_camera() {
    let place = place();
    place.run("run scene.toml --executor cpu --frames 1 --set simulation.gravity_m_s2=[0,9,0] --out other").expect(0);
    let ended = place.run("render run other --executor cpu --size 160x120").expect(0);
    assert!(ended.stdout.contains("2 pictures in run/pictures"), "{}", ended.story);
    let both = Picture::load(&place.path("run/pictures/side_by_side_000001.png"));
    assert_eq!(both.width, 2 * 160 + 6);
    assert!(both.height > 120 + 9 && both.height < 120 + 40);
    // Frame 0 is the same in both, so both halves are.
    let start = Picture::load(&place.path("run/pictures/side_by_side_000000.png"));
    let pixel = |x: usize, y: usize| &start.rgb[3 * (y * start.width + x)..][..3];
    assert!((0..120).all(|y| (0..160).all(|x| pixel(x, y) == pixel(x + 166, y))));
    assert!(place.path("run/pictures/side_by_side.png").exists());
    // They go with the run.
    place.run("run scene.toml --executor cpu --frames 1 --out run --overwrite").expect(0);
    assert!(!place.path("run/pictures/side_by_side_000000.png").exists());
    let ended = place.run("render run nowhere").expect(2);
    assert!(ended.error().contains("nowhere is not a run directory"), "{}", ended.story);
}
