//! `--set simulation.friction=0.5`: fields of a TOML scene given on the command line.

use std::path::Path;

use toml::{Table, Value};

use super::schema::takes_list;
use super::settings_file::{FRAMES, STEP_S, STEPS_PER_FRAME};

/// Most runs that lists of values may ask for.
const RUNS_MOST: usize = 1000;

/// The fields of every run that `fields` ask for. A list of values for a field that is none itself
/// (`simulation.friction=[0.1, 0.3]`) asks for a run with each of them, several lists for all combinations, of which
/// the values of the last list change first. Without lists there is one run.
///
/// # Errors
/// One sentence: a list is empty, or there are too many runs.
pub fn runs_of_fields(fields: &[String]) -> Result<Vec<Vec<String>>, String> {
    let mut runs = vec![Vec::new()];
    for field in fields {
        let mut values = vec![field.clone()];
        if let Some((path, value)) = field.split_once('=') {
            let names: Vec<&str> = path.trim().split('.').collect();
            if let Value::Array(list) = value_of(value.trim())
                && !takes_list(&names, &list)
            {
                values = list.iter().map(|value| format!("{}={}", path.trim(), written(value))).collect();
            }
        }
        if values.is_empty() {
            return Err(format!("--set {field}: the list is empty"));
        }
        runs =
            runs.iter().flat_map(|run| values.iter().map(move |value| [&run[..], &[value.clone()]].concat())).collect();
        if runs.len() > RUNS_MOST {
            return Err(format!("--set {field}: the lists ask for {} runs, more than {RUNS_MOST}", runs.len()));
        }
    }
    Ok(runs)
}

/// The text of a scene with fields set, each as `path=value`: names of tables and fields, separated by dots, with
/// numbers or names for one of several (`cloth.0.fabric=silk`, `obstacle.ball.friction=1`). A value is TOML, or else
/// text.
///
/// # Errors
/// One sentence: the text is not TOML, or a path leads nowhere.
pub fn set_fields(text: &str, fields: &[String]) -> Result<String, String> {
    if fields.is_empty() {
        return Ok(text.to_string());
    }
    let mut scene: Table = text.parse().map_err(|error: toml::de::Error| error.message().replace('\n', ", "))?;
    for field in fields {
        let wrong = |what: &str| format!("--set {field}: {what}");
        let (path, value) =
            field.split_once('=').ok_or_else(|| wrong("write FIELD=VALUE, as simulation.friction=0.5"))?;
        let names: Vec<&str> = path.trim().split('.').collect();
        if names.iter().any(|name| name.is_empty()) {
            return Err(wrong("a name is empty"));
        }
        set(&mut scene, &names, value_of(value.trim())).map_err(|what| wrong(&what))?;
    }
    toml::to_string(&scene).map_err(|error| error.to_string())
}

/// The fields, as [`set_fields`] takes them, that make the scene of `text` write `fps` frames per second: steps as long
/// as now or a little shorter or longer, so that a frame is a whole number of them, and as many frames as last as long.
///
/// # Errors
/// One sentence: the text is not TOML, or its steps are not numbers.
pub fn fields_of_fps(text: &str, fps: f64) -> Result<Vec<String>, String> {
    let scene: Table = text.parse().map_err(|error: toml::de::Error| error.message().replace('\n', ", "))?;
    let simulation = scene.get("simulation").and_then(Value::as_table);
    let number = |name: &str| -> Result<Option<f64>, String> {
        let Some(value) = simulation.and_then(|simulation| simulation.get(name)) else { return Ok(None) };
        let number = value.as_float().or(value.as_integer().map(|whole| whole as f64));
        number.filter(|number| *number > 0.0).map(Some).ok_or(format!("simulation.{name} is no number above 0"))
    };
    if number("frame_s")?.is_some() {
        let what = "--fps goes with `steps_per_frame`, and this scene has `frame_s`: use --set simulation.frame_s";
        return Err(what.into());
    }
    let step_s = number("step_s")?.unwrap_or(STEP_S);
    let frame_s = step_s * number("steps_per_frame")?.unwrap_or(f64::from(STEPS_PER_FRAME));
    let steps = (1.0 / (fps * step_s)).round().max(1.0);
    let frames = number("frames")?.unwrap_or(f64::from(FRAMES)) * frame_s * fps;
    Ok(vec![
        format!("simulation.step_s={:?}", 1.0 / (fps * steps)),
        format!("simulation.steps_per_frame={}", steps as u64),
        format!("simulation.frames={}", frames.round().max(1.0) as u64),
    ])
}

/// The text of a scene with the names of files that lie in or below `folder` made absolute, so that it can be read from
/// anywhere. A text without such names stays as it is.
///
/// # Errors
/// One sentence: the text is not TOML.
pub fn with_absolute_files(text: &str, folder: &Path) -> Result<String, String> {
    fn absolute(value: &mut Value, folder: &Path, any: &mut bool) {
        match value {
            Value::Table(table) => table.iter_mut().for_each(|(_, value)| absolute(value, folder, any)),
            Value::Array(list) => list.iter_mut().for_each(|value| absolute(value, folder, any)),
            Value::String(name) if name.contains('.') && Path::new(name).is_relative() => {
                let file = folder.join(&*name);
                if let (true, Some(path)) = (file.is_file(), file.to_str()) {
                    (*name, *any) = (path.to_string(), true);
                }
            }
            _ => {}
        }
    }
    let mut scene: Table = text.parse().map_err(|error: toml::de::Error| error.message().replace('\n', ", "))?;
    let mut any = false;
    scene.iter_mut().for_each(|(_, value)| absolute(value, folder, &mut any));
    if any { toml::to_string(&scene).map_err(|error| error.to_string()) } else { Ok(text.to_string()) }
}

/// A TOML value; what is none is text, or a list of such texts in brackets.
fn value_of(text: &str) -> Value {
    let table: Option<Table> = format!("value = {text}").parse().ok();
    let value = table.filter(|table| table.len() == 1).and_then(|mut table| table.remove("value"));
    value.unwrap_or_else(|| match text.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')) {
        Some(list) if !list.contains(['[', ']', '"', '\'']) => {
            Value::Array(list.split(',').map(|value| value_of(value.trim())).collect())
        }
        _ => Value::String(text.to_string()),
    })
}

/// A value as the command line has it: text without quotes where that is the same.
fn written(value: &Value) -> String {
    match value {
        Value::String(text) if value_of(text) == *value => text.clone(),
        other => other.to_string(),
    }
}

fn set(table: &mut Table, names: &[&str], value: Value) -> Result<(), String> {
    let (name, rest) = names.split_first().ok_or("a name is missing")?;
    if rest.is_empty() {
        table.insert((*name).to_string(), value);
        return Ok(());
    }
    // A table that the scene leaves out has its defaults.
    let next = table.entry(*name).or_insert_with(|| Value::Table(Table::new()));
    match next {
        Value::Table(next) => set(next, rest, value),
        Value::Array(list) => {
            let (which, rest) = rest.split_first().ok_or("a name is missing")?;
            let named = |entry: &Value| entry.get("name").and_then(Value::as_str) == Some(which);
            let count = list.len();
            let place = which.parse().ok().filter(|place| *place < count).or_else(|| list.iter().position(named));
            let place = place.ok_or_else(|| format!("there is no `{which}` among the {count} of `{name}`"))?;
            match &mut list[place] {
                Value::Table(next) if !rest.is_empty() => set(next, rest, value),
                entry if rest.is_empty() => {
                    *entry = value;
                    Ok(())
                }
                _ => Err(format!("`{name}.{which}` has no fields")),
            }
        }
        _ => Err(format!("`{name}` has no fields")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SCENE: &str =
        "name = \"a\"\n[[cloth]]\nname = \"flag\"\nsheet = { size_m = [3, 2] }\n[[cloth]]\nmesh = \"b.obj\"\n";

    #[test]
    fn fields_are_set_wherever_they_are() {
        let fields = [
            "simulation.friction=0.5",
            "simulation.preconditioner = jacobi",
            "cloth.0.fabric=silk",
            "cloth.flag.sheet.size_m=[1, 1]",
            "cloth.1.mesh=\"c.obj\"",
            "air.wind_m_s.0=3",
            "resolution=2_000",
        ];
        let some: Vec<String> =
            fields.iter().filter(|field| !field.starts_with("air")).map(|f| f.to_string()).collect();
        let scene: Table = set_fields(SCENE, &some).unwrap().parse().unwrap();
        assert_eq!(scene["simulation"]["friction"].as_float(), Some(0.5));
        assert_eq!(scene["simulation"]["preconditioner"].as_str(), Some("jacobi"));
        assert_eq!(scene["cloth"][0]["fabric"].as_str(), Some("silk"));
        assert_eq!(scene["cloth"][0]["sheet"]["size_m"][0].as_integer(), Some(1));
        assert_eq!((scene["cloth"][1]["mesh"].as_str(), scene["resolution"].as_integer()), (Some("c.obj"), Some(2000)));
        assert_eq!(set_fields(SCENE, &[]).unwrap(), SCENE);
        let windy = format!("{SCENE}[air]\nwind_m_s = [1, 2, 3]\n");
        let scene: Table = set_fields(&windy, &["air.wind_m_s.0=3".to_string()]).unwrap().parse().unwrap();
        assert_eq!(scene["air"]["wind_m_s"][0].as_integer(), Some(3));
    }

    #[test]
    fn lists_ask_for_runs_where_a_field_is_no_list() {
        let of = |fields: &[&str]| {
            let fields: Vec<String> = fields.iter().map(|field| field.to_string()).collect();
            runs_of_fields(&fields)
        };
        assert_eq!(of(&[]).unwrap(), [[""; 0]]);
        let grid =
            of(&["simulation.friction=[0.1, 0.3]", "cloth.flag.fabric=[\"silk\", \"denim\"]", "name=a"]).unwrap();
        assert_eq!(grid.len(), 4);
        assert_eq!(grid[1], ["simulation.friction=0.1", "cloth.flag.fabric=denim", "name=a"]);
        assert_eq!(grid[2][..2], ["simulation.friction=0.3", "cloth.flag.fabric=silk"]);
        assert_eq!(of(&["cloth.0.fabric=[silk, wool]"]).unwrap()[1], ["cloth.0.fabric=wool"]);
        // Text that would be read as a number keeps its quotes.
        assert_eq!(of(&["name=[\"1\", \"b c\"]"]).unwrap(), [["name=\"1\""], ["name=b c"]]);
        // A vector, a pair of limits and an unknown field stay what they are; a list of vectors does not.
        for field in [
            "simulation.gravity_m_s2=[0, -1, 0]",
            "air.wind_m_s=[1, 2, 3]",
            "air.wind_m_s=[{ time_s = 0, value = [1, 2, 3] }]",
            "simulation.friction_factor=[{ time_s = 0, value = 1 }]",
            "cloth.0.strain_limit=[0.9, 1.1]",
            "cloth.0.sheet.size_m=[1, 2]",
            "simulation.frictoin=[1, 2]",
            "obstacle=[]",
        ] {
            assert_eq!(of(&[field]).unwrap(), [[field]], "{field}");
        }
        assert_eq!(of(&["simulation.gravity_m_s2=[[0, -1, 0], [0, -9, 0]]"]).unwrap().len(), 2);
        assert_eq!(of(&["simulation.friction_factor=[0.5, 1]"]).unwrap().len(), 2);
        assert_eq!(of(&["cloth.0.strain_limit=[[0.9, 1.1], [0.8, 1.2], [0.7, 1.3]]"]).unwrap().len(), 3);
        assert_eq!(of(&["cloth.0.sheet.size_m.1=[1, 2]"]).unwrap().len(), 2);
        assert_eq!(of(&["resolution=[1000, 4_000]"]).unwrap()[1], ["resolution=4000"]);
        assert!(of(&["simulation.friction=[]"]).unwrap_err().contains("the list is empty"));
        let many = format!("simulation.friction={:?}", (0..40).collect::<Vec<i32>>());
        assert!(of(&[&many, &many]).unwrap_err().contains("1600 runs"));
    }

    #[test]
    fn frames_per_second_keep_the_length_of_a_shot_and_about_its_steps() {
        let of = |simulation: &str, fps: f64| {
            let text = format!("[simulation]\n{simulation}");
            let scene: Table = set_fields(&text, &fields_of_fps(&text, fps).unwrap()).unwrap().parse().unwrap();
            let simulation = scene["simulation"].as_table().unwrap().clone();
            let whole = |name: &str| simulation[name].as_integer().unwrap();
            (simulation["step_s"].as_float().unwrap(), whole("steps_per_frame"), whole("frames"))
        };
        let (step_s, steps, frames) = of("step_s = 0.004\nsteps_per_frame = 10\nframes = 50", 24.0);
        assert_eq!((steps, frames), (10, 48));
        assert!((step_s * 10.0 * 24.0 - 1.0).abs() < 1e-12);
        assert_eq!(of("step_s = 0.004\nsteps_per_frame = 10", 25.0), (0.004, 10, 100));
        // A frame shorter than a step makes shorter steps.
        assert_eq!(of("step_s = 0.01\nsteps_per_frame = 4\nframes = 10", 1000.0), (0.001, 1, 400));
        let (step_s, steps, _) = of("", 60.0);
        assert!((step_s * steps as f64 * 60.0 - 1.0).abs() < 1e-12 && steps == (1.0 / 60.0 / STEP_S).round() as i64);
        assert!(fields_of_fps("[simulation]\nframe_s = 0.04", 24.0).unwrap_err().contains("frame_s"));
        assert!(fields_of_fps("[simulation]\nstep_s = \"a\"", 24.0).unwrap_err().contains("simulation.step_s"));
    }

    #[test]
    fn files_get_absolute_names_where_they_are() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("b.obj"), "").unwrap();
        let scene: Table = with_absolute_files(SCENE, folder.path()).unwrap().parse().unwrap();
        assert_eq!(scene["cloth"][1]["mesh"].as_str(), folder.path().join("b.obj").to_str());
        assert_eq!(with_absolute_files(SCENE, Path::new("/nowhere")).unwrap(), SCENE);
    }

    #[test]
    fn a_wrong_field_is_one_sentence() {
        for (field, what) in [
            ("friction", "write FIELD=VALUE"),
            ("simulation..friction=1", "a name is empty"),
            ("cloth.silk.fabric=x", "there is no `silk` among the 2 of `cloth`"),
            ("name.first=x", "`name` has no fields"),
            ("cloth.9.fabric=x", "there is no `9`"),
        ] {
            let error = set_fields(SCENE, &[field.to_string()]).unwrap_err();
            assert!(error.starts_with(&format!("--set {field}: ")) && error.contains(what), "{error}");
        }
        assert!(set_fields("[[", &["a=1".to_string()]).is_err());
    }
}
