//! `gakp token`: makes, lists and revokes the tokens that the API asks for.

use std::path::PathBuf;

use anyhow::{Context, Result};

use super::serve::default_state_dir;
use crate::auth::{Role, TokenFile};

/// Makes, lists and revokes API tokens.
///
/// A running service takes changes up within a second. As soon as there is one token, every request needs one.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// The service's state folder [default: $STATE_DIRECTORY, $XDG_STATE_HOME/gakp or ~/.local/state/gakp].
    #[arg(long, global = true, value_name = "DIR")]
    state_dir: Option<PathBuf>,
    #[command(subcommand)]
    command: Command,
}

#[derive(Clone, Debug, clap::Subcommand)]
enum Command {
    /// Makes a token and prints it: the only time that it can be seen.
    Create {
        /// A name for it, to list and revoke it by.
        name: String,
        /// viewer: reads. operator: changes cameras on the network, lines and zones, too. admin: everything.
        #[arg(long, default_value = "viewer", value_parser = role)]
        role: Role,
        /// Lets a viewer or operator see pictures; an admin always may.
        #[arg(long)]
        video: bool,
    },
    /// Lists names, roles and rights.
    List,
    /// Revokes a token; sessions that were begun with it end.
    Revoke {
        /// Its name.
        name: String,
    },
}

fn role(text: &str) -> Result<Role, String> {
    let found = Role::ALL.into_iter().find(|role| role.as_str() == text);
    found.ok_or_else(|| format!("{text:?} is none of viewer, operator, admin"))
}

/// Does what the arguments say.
///
/// # Errors
/// The state folder cannot be used, or a name is wrong, taken or unknown.
pub fn run(args: Args) -> Result<()> {
    let folder = args.state_dir.or_else(default_state_dir).context(
        "no state folder: neither STATE_DIRECTORY nor XDG_STATE_HOME nor HOME is set; give --state-dir",
    )?;
    let path = TokenFile::path(&folder);
    let mut tokens = TokenFile::read(&path)?;
    match args.command {
        Command::Create { name, role, video } => {
            let token = tokens.create(&name, role, video || role == Role::Admin)?;
            tokens.write(&path)?;
            println!("{}", token.reveal());
            eprintln!(
                "This is token {name:?} ({}); it is kept as a hash and cannot be shown again.",
                role.as_str()
            );
        }
        Command::List => {
            for (name, token) in tokens.records() {
                let video = if token.video { "video" } else { "no video" };
                println!("{name}\t{}\t{video}\t{}", token.role.as_str(), token.created);
            }
        }
        Command::Revoke { name } => {
            tokens.revoke(&name)?;
            tokens.write(&path)?;
            eprintln!("Token {name:?} is revoked.");
        }
    }
    Ok(())
}
