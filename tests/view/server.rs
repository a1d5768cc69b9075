//! Who is answered, and what for: requests as a browser, another site or somebody without the token would send them.

use std::io::{Read, Write};
use std::net::TcpStream;

use support::process::{Place, Running, Signal, flag, signal};

/// A place with a short run in `run`.
pub(crate) fn place() -> Place {
    let place = Place::new();
    place.write("flag.toml", flag(512, 4, 6));
    place.run("run flag.toml --executor cpu --workers 2 --threads 1 --out run").expect(0);
    place
}

/// The address that a started `view` or `run --view` prints.
pub(crate) fn address(running: &mut Running) -> String {
    running.wait_for("an address", |running| {
        running.stdout().lines().find(|line| line.starts_with("http://127.0.0.1:")).map(str::to_string)
    })
}

/// Runs a command while a server of the same place goes on; its exit code and its output.
pub(crate) fn beside(place: &Place, words: &str) -> (Option<i32>, String, String) {
    let output = place.command(words).output().expect("the command");
    let [stdout, stderr] = [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
    (output.status.code(), stdout, stderr)
}

/// Ends a server.
pub(crate) fn end(running: Running) {
    signal(running.pid(), Signal::INT);
    running.wait();
}

/// Status and body of the answer to a request for `path` on the port of `address`.
fn ask(address: &str, method: &str, path: &str, headers: &[(&str, &str)]) -> (u16, Vec<u8>, String) {
    let host = address["http://".len()..].split('/').next().unwrap().to_string();
    let mut stream = TcpStream::connect(&host).unwrap();
    let mut request = format!("{method} {path} HTTP/1.1\r\nConnection: close\r\n");
    if !headers.iter().any(|(name, _)| *name == "Host") {
        request += &format!("Host: {host}\r\n");
    }
    for (name, value) in headers {
        request += &format!("{name}: {value}\r\n");
    }
    stream.write_all((request + "\r\n").as_bytes()).unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    let end = answer.windows(4).position(|w| w == b"\r\n\r\n").expect("a head") + 4;
    let head = String::from_utf8_lossy(&answer[..end]).into_owned();
    let status = head.split(' ').nth(1).and_then(|code| code.parse().ok()).expect("a status");
    (status, answer[end..].to_vec(), head)
}

#[test]
fn only_the_printed_address_is_answered() {
    let place = place();
    let mut view = place.start("view run");
    let address = address(&mut view);
    let base = format!("/{}", address["http://".len()..].split_once('/').unwrap().1);
    assert!(base.len() >= 34, "{base}");
    let status = |method: &str, path: &str, headers: &[(&str, &str)]| ask(&address, method, path, headers).0;

    let (code, body, head) = ask(&address, "GET", &base, &[]);
    assert_eq!(code, 200);
    assert!(String::from_utf8_lossy(&body).contains("<canvas id=\"view\""));
    for needed in ["Content-Security-Policy: default-src 'none'", "X-Frame-Options: DENY", "nosniff", "no-referrer"] {
        assert!(head.contains(needed), "{needed}: {head}");
    }
    for file in
        ["app.js", "decode.js", "style.css", "runs", "run/0/state", "run/0/mesh", "run/0/frame/3", "run/0/names"]
    {
        assert_eq!(status("GET", &format!("{base}{file}"), &[]), 200, "{file}");
    }
    // Without the token, with a wrong one, from another site, under another name.
    for path in ["/", "/app.js", "/run/0/state", "/00000000000000000000000000000000/", &base[..base.len() - 1]] {
        assert_eq!(status("GET", path, &[]), 403, "{path}");
    }
    for headers in [("Host", "evil.example"), ("Origin", "http://evil.example"), ("Origin", "null")] {
        assert_eq!(status("GET", &base, &[headers]), 403, "{headers:?}");
    }
    for method in ["PUT", "DELETE", "OPTIONS"] {
        assert_eq!(status(method, &base, &[("Content-Length", "0")]), 405, "{method}");
    }
    // Only the page itself may ask a run to change, and only where a run is.
    let own = ("Origin", &address[..address["http://".len()..].find('/').unwrap() + "http://".len()]);
    let empty = ("Content-Length", "0");
    let steer = format!("{base}run/0/live");
    assert_eq!(status("POST", &steer, &[empty]), 403);
    assert_eq!(status("POST", &steer, &[empty, ("Origin", "http://evil.example")]), 403);
    assert_eq!(status("POST", &steer, &[own]), 400);
    assert_eq!(status("POST", &steer, &[own, ("Content-Length", "99999999999")]), 400);
    assert_eq!(status("POST", &base, &[own, empty]), 405);
    let (code, body, _) = ask(&address, "POST", &steer, &[own, empty]);
    assert_eq!(code, 200);
    assert!(String::from_utf8_lossy(&body).contains("no live run listens"));
    // Nothing outside of the run, and nothing of it but what the page needs.
    place.write("secret", "not to be read");
    for path in [
        "../secret",
        "run/0/../../secret",
        "run/0/run.toml",
        "run/0/frame/..%2f..%2fsecret",
        "run/0/frame/x",
        "run/1/state",
    ] {
        let (code, body, _) = ask(&address, "GET", &format!("{base}{path}"), &[]);
        assert_eq!(code, 404, "{path}");
        assert!(String::from_utf8_lossy(&body).starts_with("{\"error\""), "{path}");
    }
    end(view);
}

#[test]
fn a_frame_comes_with_the_bits_of_its_file() {
    use loomtree::output::{FrameSource, RunDirectory};
    let place = place();
    let mut view = place.start("view run");
    let address = address(&mut view);
    let base = format!("/{}", address["http://".len()..].split_once('/').unwrap().1);
    let (_, bytes, _) = ask(&address, "GET", &format!("{base}run/0/frame/5"), &[]);
    let source = FrameSource::open(&RunDirectory::open(&place.path("run")).unwrap()).unwrap();
    let positions = source.read(5).unwrap().positions;
    let expected: Vec<u8> = positions.iter().flat_map(|p| p.to_array()).flat_map(f32::to_le_bytes).collect();
    assert_eq!(bytes[32..], expected);
    let (_, bytes, _) = ask(&address, "GET", &format!("{base}run/0/values/rank"), &[]);
    let ranks: Vec<f32> = bytes.chunks(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
    assert_eq!(ranks.len(), positions.len());
    let of_first = ranks.iter().filter(|rank| **rank == 0.0).count();
    let of_second = ranks.iter().filter(|rank| **rank == 1.0).count();
    assert!(
        of_first + of_second == ranks.len() && of_first.abs_diff(of_second) <= ranks.len() / 4,
        "{of_first} {of_second}"
    );
    // Cloth that has not moved yet has no strain; later it has, and within what its fabric allows.
    let strain = |frame: u32| -> f32 {
        let (_, bytes, _) = ask(&address, "GET", &format!("{base}run/0/values/strain/{frame}"), &[]);
        assert_eq!(bytes.len(), 4 * positions.len());
        bytes.chunks(4).map(|b| f32::from_le_bytes(b.try_into().unwrap()).abs()).fold(0.0, f32::max)
    };
    assert!(strain(0) < 1e-5, "{}", strain(0));
    assert!((1e-4..0.5).contains(&strain(6)), "{}", strain(6));
    let (code, bytes, _) = ask(&address, "GET", &format!("{base}run/0/values/contact/6"), &[]);
    assert_eq!((code, bytes.len()), (200, 4 * positions.len()));
    end(view);
}

#[test]
fn what_cannot_be_shown_is_one_sentence() {
    let place = Place::new();
    place.write("a_file", "x");
    std::fs::create_dir(place.path("empty")).unwrap();
    for (words, sentence) in [
        ("view nowhere", "nowhere is not there"),
        ("view empty", "empty is not a run directory"),
        ("view a_file", "a_file"),
        ("view", "there is no run in out/"),
        ("run flag.toml --port 8000", "--port and --open go with --view"),
    ] {
        place.write("flag.toml", flag(512, 4, 1));
        let ended = place.run(words).expect(2);
        assert!(ended.error().contains(sentence), "{}", ended.story);
    }
    let run = place.path("out/some/report.json");
    std::fs::create_dir_all(run.parent().unwrap()).unwrap();
    std::fs::write(&run, "{}").unwrap();
    // The newest run of out/ is the one that is shown; a port that is taken is said to be.
    let mut view = place.start("view");
    let address = address(&mut view);
    let port = address["http://127.0.0.1:".len()..].split('/').next().unwrap().to_string();
    let (code, _, stderr) = beside(&place, &format!("view out/some --port {port}"));
    end(view);
    assert_eq!(code, Some(2), "{stderr}");
    assert!(stderr.starts_with(&format!("error: cannot listen on 127.0.0.1:{port}")), "{stderr}");
}
