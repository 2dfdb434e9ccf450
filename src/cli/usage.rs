//! Definition of the command line, and usage errors in one line each, with a suggestion.
use super::Program;
use super::args::Cli;
use super::line::one_line;
use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{Command, CommandFactory};
use std::error::Error as _;
use std::ffi::OsString;
use std::num::{ParseFloatError, ParseIntError};

/// Command line of a program, for the parser and for shell completions.
pub fn command<P: Program>() -> Command {
    build::<P>(P::command())
}

/// Command line for man pages, which `splatvk help` has none of.
pub fn manual() -> Command {
    build::<Cli>(Cli::command().disable_help_subcommand(true))
}

fn build<P: Program>(all: Command) -> Command {
    let mut all = all.mut_subcommands(numbers_may_be_negative);
    // Adds the options of all commands to each of them.
    all.build();
    P::UNUSED.iter().fold(all, |all, (path, options)| hide(all, path, options))
}

/// "--views -3" is a number that is refused, not an option "-3".
fn numbers_may_be_negative(command: Command) -> Command {
    let takes_value = |a: &clap::Arg| a.get_action().takes_values() && !a.is_positional();
    let command = command.mut_args(|a| if takes_value(&a) { a.allow_negative_numbers(true) } else { a });
    command.mut_subcommands(numbers_may_be_negative)
}

fn hide(command: Command, path: &str, options: &[&str]) -> Command {
    match path.split_once(' ') {
        Some((first, rest)) => command.mut_subcommand(first, |c| hide(c, rest, options)),
        None => command.mut_subcommand(path, |c| {
            c.mut_args(|a| if options.contains(&a.get_id().as_str()) { a.hide(true) } else { a })
        }),
    }
}

/// Parses arguments, or prints the error and returns its exit code.
pub fn parse<P: Program>(arguments: Vec<OsString>) -> Result<P, u8> {
    let parsed = command::<P>().try_get_matches_from(arguments).and_then(|found| P::from_arg_matches(&found));
    parsed.map_err(|error| print_usage_error(&error, &command::<P>()))
}

/// Prints help and version to standard output, and a usage error as one line with exit code 2.
fn print_usage_error(error: &clap::Error, all: &Command) -> u8 {
    let help = matches!(
        error.kind(),
        ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand | ErrorKind::MissingSubcommand
    );
    let requested = matches!(error.kind(), ErrorKind::DisplayHelp | ErrorKind::DisplayVersion);
    if requested || help {
        // A closed pipe while printing help is no failure.
        let _ = error.print();
        return if requested { 0 } else { 2 };
    }
    eprintln!("{}: {}", all.get_name(), one_line(&message(error, all)));
    2
}

/// Problem, suggestion and the command whose help shows the rest.
fn message(error: &clap::Error, all: &Command) -> String {
    let text = |kind| texts(error, kind).into_iter().next().unwrap_or_default();
    // "--views <N>": its name is enough.
    let option = || text(ContextKind::InvalidArg).split(' ').next().unwrap_or_default().to_owned();
    let meant = |kind| match texts(error, kind).first() {
        Some(near) => format!("; did you mean {near}?"),
        None => String::new(),
    };
    let value = text(ContextKind::InvalidValue);
    let wrong = match error.kind() {
        ErrorKind::InvalidSubcommand => {
            let name = text(ContextKind::InvalidSubcommand);
            let near = match meant(ContextKind::SuggestedSubcommand) {
                none if none.is_empty() => anagram_suggestion(error, all, &name),
                near => near,
            };
            format!("there is no command {name}{near}")
        }
        ErrorKind::UnknownArgument if option().starts_with('-') => {
            format!("there is no option {}{}", option(), meant(ContextKind::SuggestedArg))
        }
        ErrorKind::UnknownArgument => {
            format!("{}: nothing more is expected here; put texts of several words in quotes", option())
        }
        ErrorKind::InvalidValue if value.is_empty() => format!("{}: its value is missing", option()),
        ErrorKind::InvalidValue => {
            let (near, all) = (meant(ContextKind::SuggestedValue), texts(error, ContextKind::ValidValue));
            format!("{} {value}: unknown{near}; give {}", option(), choices(&all))
        }
        // The reason states the range.
        ErrorKind::ValueValidation => return format!("{} {value}: {}", option(), reason(error)),
        ErrorKind::ArgumentConflict if !text(ContextKind::PriorArg).is_empty() => {
            let other = texts(error, ContextKind::PriorArg).join(", ");
            format!("{} cannot be used together with {other}; leave one of them out", option())
        }
        ErrorKind::MissingRequiredArgument => {
            format!("{} missing", texts(error, ContextKind::InvalidArg).join(", "))
        }
        // The message may span several lines before the usage.
        _ => {
            let text = error.to_string();
            text.split("\n\n").next().unwrap_or(&text).trim_start_matches("error: ").to_owned()
        }
    };
    format!("{wrong}; {} --help shows what there is", command_path(error, all))
}

/// Suggests a command with the same letters in another order: clap's edit distance finds nothing
/// near "rnu".
fn anagram_suggestion(error: &clap::Error, all: &Command, name: &str) -> String {
    let path = command_path(error, all);
    let parent = path.split(' ').skip(1).try_fold(all, |c, word| c.find_subcommand(word));
    let is_anagram = |c: &&Command| sorted_letters(c.get_name()) == sorted_letters(name);
    let meant = parent.and_then(|c| c.get_subcommands().find(is_anagram));
    meant.map_or(String::new(), |c| format!("; did you mean {}?", c.get_name()))
}

fn sorted_letters(word: &str) -> Vec<char> {
    let mut letters: Vec<char> = word.chars().collect();
    letters.sort_unstable();
    letters
}

/// Reason of the value's parser, in words.
fn reason(error: &clap::Error) -> String {
    let Some(source) = error.source() else { return "cannot be used".to_owned() };
    if source.is::<ParseFloatError>() {
        return "not a number; give one such as 0.5".to_owned();
    }
    if source.is::<ParseIntError>() {
        return "not a whole number".to_owned();
    }
    source.to_string()
}

fn texts(error: &clap::Error, kind: ContextKind) -> Vec<String> {
    match error.get(kind) {
        Some(ContextValue::String(text)) => vec![text.clone()],
        Some(ContextValue::Strings(all)) => all.clone(),
        _ => Vec::new(),
    }
}

/// Joins choices: "draft, default or paper".
fn choices(all: &[String]) -> String {
    match all {
        [most @ .., last] if !most.is_empty() => format!("{} or {last}", most.join(", ")),
        all => all.join(", "),
    }
}

/// Command path up to its first argument: "splatvk models list".
fn command_path(error: &clap::Error, all: &Command) -> String {
    let usage = match error.get(ContextKind::Usage) {
        Some(ContextValue::StyledStr(usage)) => usage.to_string(),
        _ => String::new(),
    };
    let words = usage.trim_start_matches("Usage:").split_whitespace();
    let words: Vec<&str> = words.take_while(|w| w.starts_with(char::is_alphanumeric)).collect();
    if words.is_empty() { all.get_name().to_owned() } else { words.join(" ") }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message_of(line: &[&str]) -> String {
        let all = command::<Cli>();
        let error = all.clone().try_get_matches_from(["splatvk"].iter().chain(line)).unwrap_err();
        one_line(&message(&error, &all))
    }

    #[test]
    fn command_definitions_are_consistent() {
        command::<Cli>().debug_assert();
    }

    #[test]
    fn usage_errors_suggest_near_names() {
        for (line, expected) in [
            (&["rnu"][..], "there is no command rnu; did you mean run?; splatvk --help"),
            (&["models", "lsit"], "there is no command lsit; did you mean list?; splatvk models --help"),
            (&["run", "x", "--quary", "lemon"], "there is no option --quary; did you mean --query?"),
            (&["run", "x", "--view", "4"], "there is no option --view; did you mean --views?; splatvk run"),
            (
                &["run", "x", "--preset", "drat"],
                "--preset drat: unknown; did you mean draft?; give draft, default or paper",
            ),
            (&["run", "x", "--log", "jsn"], "--log jsn: unknown; did you mean json?; give text or json"),
            (&["run", "x", "--compat", "none", "--methd"], "no option --methd; did you mean --method?"),
            (&["render", "x", "y"], "y: nothing more is expected here"),
            (&["render", "x", "--out", "y"], "--cameras <FILE> missing; splatvk render --help"),
            (&["run", "x", "--views"], "--views: its value is missing"),
            (&["run", "x", "--add", "s", "--views", "3"], "cannot be used together with"),
            (&["export", "x", "--format", "plz", "--out", "y"], "--format plz: unknown; did you mean ply?"),
        ] {
            let text = message_of(line);
            assert!(text.contains(expected), "{line:?}: {text}");
        }
    }

    #[test]
    fn invalid_numbers_state_their_range() {
        for (line, expected) in [
            (&["run", "x", "--views", "abc"][..], "--views abc: not a whole number; give 2 or more"),
            (&["run", "x", "--views", "4.0"], "--views 4.0: not a whole number; give 2 or more"),
            (&["run", "x", "--views", "-3"], "--views -3: give 2 or more"),
            (&["run", "x", "--views", "1"], "--views 1: give 2 or more"),
            (&["run", "x", "--sh-degree", "4"], "--sh-degree 4: give 0 to 3"),
            (&["run", "x", "--iterations", "0"], "--iterations 0: give 1 or more"),
            (
                &["run", "x", "--seed", "99999999999999999999"],
                "--seed 99999999999999999999: too large; give 0",
            ),
            (&["run", "x", "--max-size", "1e3"], "--max-size 1e3: not a whole number; give 64 or more"),
            (&["view", "x", "--port", "70000"], "--port 70000: give 0 to 65535"),
            (&["bench", "--sweep", "1,x"], "--sweep x: not a whole number; give 1 or more"),
        ] {
            let text = message_of(line);
            assert!(text.contains(expected), "{line:?}: {text}");
        }
    }

    fn help(path: &str) -> String {
        let words = path.split(' ');
        let mut found = words.fold(command::<Cli>(), |c, name| c.find_subcommand(name).unwrap().clone());
        found.render_help().to_string()
    }

    #[test]
    fn help_shows_only_used_options() {
        for path in ["clean", "models list", "export"] {
            let text = help(path);
            assert!(!text.contains("--provider") && !text.contains("--log"), "{path}: {text}");
        }
        let text = help("run");
        let position =
            |option: &str| text.find(&format!("{option} ")).unwrap_or_else(|| panic!("{option}: {text}"));
        assert!(position("--query") < position("--views"), "{text}");
        assert!(position("--max-size") < position("--compat"), "{text}");
        let headings: Vec<&str> = text.lines().filter(|l| l.ends_with(':') && !l.starts_with(' ')).collect();
        assert!(headings.len() >= 5, "{headings:?}");
    }
}
